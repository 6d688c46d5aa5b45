"""Stacks drawn from the table equal, bit for bit, what the environment itself showed, for any cut and eviction."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import Seen, cut, record

from coop.common.settings.environment import EnvSettings
from coop.common.types import EnvSpec
from coop.replay.table.table import Table


@cache
def played(num_envs: int) -> tuple[EnvSpec, Seen]:
    """Games full of lost lives, truncations and new starts."""
    config = EnvSettings(id="breakout", stack=4, episodic_life=True, max_episode_steps=67, noop_max=3)
    return record(config, num_envs, {1: 400, 6: 120, 16: 80}[num_envs])


def check_draws(spec: EnvSpec, seen: Seen, segment_steps: int, share_held: float, eviction: str, seed: int) -> None:
    num_envs = len(seen[0][0])
    capacity = round(share_held * len(seen) * num_envs)
    table = Table(spec, capacity, eviction=eviction, rng=np.random.default_rng(seed))
    numbered = []  # (step, stream) of each transition in order of insertion
    for segment in cut(spec, seen, segment_steps):
        first = segment.sequence * segment_steps
        numbered += [(step, segment.stream) for step in range(first, first + segment.steps)]
        table.insert(segment)
        batch = table.sample(8)
        for row, (step, stream) in enumerate(numbered[number] for number in batch.ids.tolist()):
            obs, actions, took, next_obs = seen[step]
            for index, shown in ((batch.obs_index, obs), (batch.next_index, next_obs)):
                drawn = batch.frames[index[row]].reshape(spec.obs_shape)
                assert (drawn.dtype, drawn.tobytes()) == (shown.dtype, shown[stream].tobytes())
            assert batch.actions[row] == actions[stream]
            assert batch.rewards[row] == took.rewards[stream]
            assert batch.terminated[row] == took.terminated[stream]
    assert len(numbered) == len(seen) * num_envs


@pytest.mark.parametrize("num_envs", [1, 6, 16])
@given(
    segment_steps=st.integers(2, 70),
    share_held=st.floats(0.02, 1.0),
    eviction=st.sampled_from(["fifo", "reservoir", "prioritized"]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=6)
def test_any_draw_shows_what_was_seen(
    num_envs: int, segment_steps: int, share_held: float, eviction: str, seed: int
) -> None:
    spec, seen = played(num_envs)
    check_draws(spec, seen, segment_steps, share_held, eviction, seed)


@cache
def walked(kind: str, stack: int) -> tuple[EnvSpec, Seen]:
    """A user's environment, whose every frame is unlike all others."""
    return record(EnvSettings(id="my_envs:Room-v0", kwargs={"kind": kind}, stack=stack), 2, 90)


@pytest.mark.parametrize("kind", ["colour", "planes", "depth"])
@pytest.mark.parametrize("stack", [1, 3])
@given(
    segment_steps=st.integers(2, 40),
    share_held=st.floats(0.05, 1.0),
    eviction=st.sampled_from(["fifo", "reservoir", "prioritized"]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=4)
def test_frames_of_any_shape_and_dtype_come_back_as_they_were(
    kind: str, stack: int, segment_steps: int, share_held: float, eviction: str, seed: int
) -> None:
    spec, seen = walked(kind, stack)
    check_draws(spec, seen, segment_steps, share_held, eviction, seed)


@pytest.mark.parametrize("num_envs", [1, 6, 16])
def test_what_was_seen_has_ends_of_every_sort(num_envs: int) -> None:
    _, seen = played(num_envs)
    steps = [took for _, _, took, _ in seen]
    assert any((took.terminated & ~took.restarted).any() for took in steps), "lost lives"
    assert any((took.restarted & ~took.terminated).any() for took in steps), "truncations"
