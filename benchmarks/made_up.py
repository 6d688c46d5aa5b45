"""Made-up transitions for the scripts in this folder: segments without end, and batches."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import msgspec
import numpy as np

from coop.common.transitions import Batch, Segment
from coop.common.types import EnvSpec

ATARI = EnvSpec("Atari", (84, 84), "uint8", 4, 4)


def segments(spec: EnvSpec, steps: int, streams: int = 8) -> Iterator[Segment]:
    """Yield segments of several streams without end, all steps within episodes, each repeating one stack of frames."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (streams, steps + spec.stack, *spec.frame_shape)).astype(spec.frame_dtype)
    frames[:, : spec.stack] = frames[:, steps:]  # the next segment of a stream begins as the last one ended
    index = (np.arange(steps)[:, None] + np.arange(spec.stack)).astype(np.int32)
    first = Segment(
        incarnation=1,
        stream=0,
        sequence=0,
        frames=frames[0],
        obs_index=index,
        next_index=index + 1,
        actions=rng.integers(0, spec.num_actions, steps).astype(np.int32),
        rewards=rng.random(steps, np.float32),
        terminated=np.zeros(steps, np.bool_),
        param_version=np.zeros(steps, np.int64),
        span=np.ones(steps, np.uint8),
    )
    for sequence in count():
        carried = spec.stack if sequence else 0
        for stream in range(streams):
            changed = {"stream": stream, "sequence": sequence, "frames": frames[stream], "carried": carried}
            yield msgspec.structs.replace(first, **changed)


def random_batch(spec: EnvSpec, size: int) -> Batch:
    """A batch of transitions that share no frames with each other."""
    rng = np.random.default_rng(0)
    span = spec.stack + 1
    shape = (size * span, *spec.frame_shape)
    top = {"uint8": 256, "bool": 2}.get(spec.frame_dtype)
    frames = rng.standard_normal(shape, np.float32) if top is None else rng.integers(top, size=shape)
    index = np.arange(size * span, dtype=np.int32).reshape(size, span)
    return Batch(
        frames=frames.astype(spec.frame_dtype),
        obs_index=index[:, :-1],
        next_index=index[:, 1:],
        actions=rng.integers(spec.num_actions, size=size).astype(np.int32),
        rewards=rng.random(size).astype(np.float32),
        terminated=np.zeros(size, np.bool_),
        weights=np.ones(size, np.float32),
        ids=np.arange(size),
        param_version=np.zeros(size, np.int64),
        age=np.arange(size),
        reuse=np.ones(size, np.int32),
        span=np.ones(size, np.uint8),
    )
