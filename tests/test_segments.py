"""Segments rebuild every observation of the environment itself, bit for bit; episodes are counted exactly."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import INCARNATION, cut, record

from coop.actors.segments import SegmentAssembler
from coop.common.envs.protocol import Steps
from coop.common.settings.environment import EnvSettings
from coop.common.transitions import Segment
from coop.common.types import Array, EnvSpec, EpisodeEnd


def rebuilt(segments: list[Segment], spec: EnvSpec) -> dict[int, list[Array]]:
    """By stream: obs, next_obs, actions, rewards, terminated, param_version of all its segments in a row."""
    rows = {}
    for segment in segments:
        shape = (segment.steps, *spec.obs_shape)
        values = (
            segment.frames[segment.obs_index].reshape(shape),
            segment.frames[segment.next_index].reshape(shape),
            segment.actions,
            segment.rewards,
            segment.terminated,
            segment.param_version,
        )
        rows.setdefault(segment.stream, []).append(values)
    return {stream: [np.concatenate(column) for column in zip(*parts, strict=True)] for stream, parts in rows.items()}


def check_chain(segments: list[Segment], spec: EnvSpec) -> None:
    """Types, exact sequence numbers, and carried frames that repeat the previous segment's last ones."""
    last = {}
    for segment in segments:
        before = last.get(segment.stream)
        assert segment.incarnation == INCARNATION
        assert segment.sequence == (before.sequence + 1 if before else 0)
        assert segment.frames.dtype == spec.frame_dtype
        assert segment.frames.shape[1:] == spec.frame_shape
        assert segment.obs_index.dtype == segment.next_index.dtype == np.int32
        assert segment.obs_index.shape == segment.next_index.shape == (segment.steps, spec.stack)
        used = np.union1d(segment.obs_index, segment.next_index)
        assert used.min() >= 0
        assert used.max() < len(segment.frames)
        if before:
            assert 1 <= segment.carried <= spec.stack
            np.testing.assert_array_equal(segment.frames[: segment.carried], before.frames[-segment.carried :])
        else:
            assert segment.carried == 0
        last[segment.stream] = segment


BREAKOUT = {"id": "breakout", "stack": 4, "clip_rewards": True}


@pytest.mark.parametrize(
    ("options", "num_envs", "steps", "segment_steps"),
    [
        (BREAKOUT, 1, 300, 64),
        (BREAKOUT | {"episodic_life": True}, 1, 300, 7),
        (BREAKOUT | {"max_episode_steps": 5}, 4, 33, 10),
        (BREAKOUT | {"episodic_life": True, "max_episode_steps": 60}, 4, 130, 64),
        (BREAKOUT | {"episodic_life": True, "max_episode_steps": 29, "noop_max": 3}, 9, 61, 16),
        (BREAKOUT | {"stack": 1, "max_episode_steps": 20}, 2, 50, 16),
        ({"id": "coop/Catch-v0", "stack": 4}, 1, 200, 16),
        ({"id": "coop/Catch-v0", "stack": 2}, 3, 100, 1),
        ({"id": "CartPole-v0"}, 1, 500, 50),
        ({"id": "CartPole-v0", "max_episode_steps": 4}, 8, 200, 3),
    ],
)
def test_segments_rebuild_every_observation(
    options: dict[str, Any], num_envs: int, steps: int, segment_steps: int
) -> None:
    spec, seen = record(EnvSettings(**options), num_envs, steps)
    segments = cut(spec, seen, segment_steps)
    check_chain(segments, spec)
    streams = rebuilt(segments, spec)
    assert sorted(streams) == list(range(num_envs))
    for stream, (obs, next_obs, actions, rewards, terminated, version) in streams.items():
        np.testing.assert_array_equal(obs, [saw[stream] for saw, _, _, _ in seen])
        np.testing.assert_array_equal(next_obs, [led[stream] for _, _, _, led in seen])
        np.testing.assert_array_equal(actions, [acted[stream] for _, acted, _, _ in seen])
        np.testing.assert_array_equal(rewards, [took.rewards[stream] for _, _, took, _ in seen])
        np.testing.assert_array_equal(terminated, [took.terminated[stream] for _, _, took, _ in seen])
        np.testing.assert_array_equal(version, np.arange(steps) // 3)
    if "max_episode_steps" in options or num_envs == 1:
        assert any(took.restarted.any() for _, _, took, _ in seen), "a run without a restart shows little"


def test_continuing_frames_are_stored_once() -> None:
    segments = cut(*record(EnvSettings(**BREAKOUT, episodic_life=True), 1, 128), 64)
    assert [len(segment.frames) for segment in segments] == [2 + 64, 4 + 64]
    assert [segment.carried for segment in segments] == [0, 4]


@given(
    stack=st.integers(1, 4),
    restarts=st.lists(st.tuples(st.booleans(), st.booleans(), st.integers(0, 3)), min_size=1, max_size=40),
    segment_steps=st.integers(1, 9),
    flush_at=st.integers(0, 40),
)
@settings(max_examples=150)
def test_any_pattern_of_restarts_and_cuts_rebuilds(
    stack: int, restarts: list[tuple[bool, bool, int]], segment_steps: int, flush_at: int
) -> None:
    """Made-up streams whose frames are numbers: restarts anywhere, in a row too, with frames that repeat."""
    spec = EnvSpec("made-up", (1,), "uint8", stack, 2)
    rng = np.random.default_rng(len(restarts))

    def fresh(padding: int) -> Array:
        stacked = rng.integers(0, 256, (2, stack, 1), dtype=np.uint8)
        stacked[:, : min(padding, stack - 1)] = 0
        return stacked

    def observed(stacked: Array) -> Array:
        return stacked.reshape(2, *spec.obs_shape).copy()

    held = fresh(3)
    assembler = SegmentAssembler(spec, 2, INCARNATION, segment_steps)
    assembler.begin(observed(held))
    segments, seen = [], []
    for step, (*ends, padding) in enumerate(restarts):
        led = np.concatenate([held[:, 1:], rng.integers(0, 256, (2, 1, 1), dtype=np.uint8)], axis=1)
        restarted = np.array(ends)
        now = np.where(restarted[:, None, None], fresh(padding), led)
        seen.append((observed(held), observed(led)))
        no = np.zeros(2, bool)
        took = Steps(observed(now), observed(led), np.zeros(2, np.float32), np.zeros(2), no, restarted, no)
        segments += assembler.add(np.zeros(2, np.int32), took, step, {})
        if step == flush_at:
            segments += assembler.flush()
            assert assembler.flush() == []
        held = now
    segments += assembler.flush()
    check_chain(segments, spec)
    assert all(segment.steps <= segment_steps for segment in segments)
    for stream, (obs, next_obs, *_, version) in rebuilt(segments, spec).items():
        np.testing.assert_array_equal(version, np.arange(len(restarts)))
        np.testing.assert_array_equal(obs, [saw[stream] for saw, _ in seen])
        np.testing.assert_array_equal(next_obs, [led[stream] for _, led in seen])


def steps_of(rewards: list[float], over: list[bool]) -> Steps:
    rewards, over, no = np.array(rewards, float), np.array(over), np.zeros(len(over), bool)
    obs = np.zeros((len(over), 4), np.float32)
    return Steps(obs, obs, np.sign(rewards).astype(np.float32), rewards, no, over, over)


def test_episode_ends_travel_in_the_segment_of_their_last_step() -> None:
    spec = EnvSpec("made-up", (4,), "float32", 1, 2)
    assembler = SegmentAssembler(spec, 2, INCARNATION, 3)
    assembler.begin(np.zeros((2, 4), np.float32))
    end = EpisodeEnd(-1, 12.0, 5, 0.1, 0.5, 0.25, 9)
    segments = []
    for step, ends in enumerate([{}, {1: end}, {0: end, 1: end}, {0: end}]):
        over = [stream in ends for stream in range(2)]
        segments += assembler.add(np.zeros(2, np.int32), steps_of([0, 0], over), step, ends)
    segments += assembler.flush()
    sent = [(s.stream, s.sequence, [e.step_in_segment for e in s.episodes]) for s in segments]
    assert sent == [(0, 0, [2]), (1, 0, [1, 2]), (0, 1, [0]), (1, 1, [])]
    assert segments[0].episodes[0].episode_return == 12.0
