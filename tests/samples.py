"""Small valid messages for tests to send and to break, real play cut into segments, and which PyTorch this is."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from coop.actors.segments import SegmentAssembler
from coop.common.envs.make import make_vector_env
from coop.common.envs.protocol import Steps
from coop.common.messaging.transport import Node
from coop.common.settings.environment import EnvSettings
from coop.common.transitions import Segment
from coop.common.types import Array, EnvSpec, EpisodeEnd

INCARNATION = 77
_CONSTRAINTS = (Path(__file__).parents[1] / "constraints.txt").read_text(encoding="utf-8").splitlines()
PINNED = f"torch=={torch.__version__.partition('+')[0]}" in _CONSTRAINTS  # whose rounding exact figures are of


def make_segment(spec: EnvSpec, sequence: int = 0, steps: int = 4, incarnation: int = 7, **changes: object) -> Segment:
    """Consecutive steps with distinguishable frames; the last step ends an episode."""
    first = sequence * steps
    numbers = np.arange(first, first + steps + 1, dtype=np.float32).reshape(-1, *[1] * len(spec.frame_shape))
    frames = numbers + np.zeros(spec.frame_shape, np.float32)
    index = np.arange(steps, dtype=np.int32)[:, None]
    values: dict[str, object] = {
        "incarnation": incarnation,
        "stream": 0,
        "sequence": sequence,
        "frames": frames.astype(spec.frame_dtype),
        "obs_index": index,
        "next_index": index + 1,
        "actions": np.zeros(steps, np.int32),
        "rewards": np.arange(first, first + steps, dtype=np.float32),
        "terminated": np.zeros(steps, np.bool_),
        "param_version": np.zeros(steps, np.int64),
        "span": np.ones(steps, np.uint8),
        "carried": min(sequence, 1),
        "acked": first,
        "episodes": (EpisodeEnd(steps - 1, 1.5, steps, 0.1, 0.2, 0.3, 5),),
    }
    return Segment(**{**values, **changes})  # type: ignore[arg-type]


def await_service(asker: Node, key: str) -> None:
    """Wait until a node has heard that another one answers queries on `key`; before, its queries find nobody."""
    querier = asker.session.declare_querier(key)
    deadline = time.monotonic() + 10
    while not querier.matching_status.matching:
        assert time.monotonic() < deadline, f"nobody answers on {key}"
        time.sleep(0.01)
    querier.undeclare()


def until(reached: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait for a condition; fail if it is not reached in time."""
    deadline = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.02)


Seen = list[tuple[Array, Array, Steps, Array]]


def record(config: EnvSettings, num_envs: int, steps: int, seed: int = 0) -> tuple[EnvSpec, Seen]:
    """Play at random; everything the environment said, step by step: obs, actions, steps, next_obs."""
    env = make_vector_env(config, num_envs, seed)
    rng = np.random.default_rng(seed)
    obs = env.reset()
    seen = []
    for _ in range(steps):
        actions = rng.integers(0, env.spec.num_actions, num_envs).astype(np.int32)
        took = env.step(actions)
        seen.append((obs.copy(), actions, took, took.next_obs.copy()))
        obs = took.obs
    env.close()
    return env.spec, seen


def cut(spec: EnvSpec, seen: Seen, segment_steps: int) -> list[Segment]:
    """The segments of what was seen; three steps each share a parameter version."""
    assembler = SegmentAssembler(spec, len(seen[0][0]), INCARNATION, segment_steps)
    assembler.begin(seen[0][0])
    segments = []
    for step, (_, actions, took, _) in enumerate(seen):
        segments += assembler.add(actions, took, step // 3, {})
    return segments + assembler.flush()
