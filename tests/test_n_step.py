"""n-step transitions: exact across terminal states, truncation, lost lives, and wherever segments are cut."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import INCARNATION
from table_reference import Stream, make_spec, table_stats, whole_state

from coop.actors.segments import SegmentAssembler
from coop.common.envs.protocol import Steps
from coop.common.messaging import wire
from coop.common.messaging.messages.insert import SegmentReader, encode_segment
from coop.common.transitions import Segment
from coop.common.types import EnvSpec, EpisodeEnd
from coop.replay.table.table import Table

GAMMA = 0.5
SPEC = EnvSpec("made-up", (1,), "float32", 1, 2)
GOES_ON, LIFE_LOST, TERMINAL, TRUNCATED = range(4)

Transition = tuple[int, float, float, bool, int]  # obs, return, next obs, terminated, span


def play(rewards: list[float], kinds: list[int], n: int, segment_steps: int, flush_at: int = -1) -> list[Segment]:
    """Segments of one stream whose frames are numbers: step t leads from t to t + 1; an end restarts at t + 1.5."""
    assembler = SegmentAssembler(SPEC, 1, INCARNATION, segment_steps, n_step=n, gamma=GAMMA)
    assembler.begin(np.zeros((1, 1), np.float32))
    segments = []
    for t, (reward, kind) in enumerate(zip(rewards, kinds, strict=True)):
        led = np.full((1, 1), t + 1, np.float32)
        restarted = np.array([kind >= TERMINAL])
        took = Steps(
            obs=led + np.float32(0.5) * restarted,
            next_obs=led,
            rewards=np.array([reward], np.float32),
            raw_rewards=np.array([reward]),
            terminated=np.array([kind in (LIFE_LOST, TERMINAL)]),
            restarted=restarted,
            episode_over=restarted,
        )
        ends = {0: EpisodeEnd(-1, float(t), 1, 0.0, 0.0, 0.0, 0)} if kind >= TERMINAL else {}
        segments += assembler.add(np.array([t % 2], np.int32), took, t, ends)
        if t == flush_at:
            segments += assembler.flush()
    return segments + assembler.flush()


def transitions(segments: list[Segment]) -> list[Transition]:
    """All of them, with every invariant of a chain of segments checked."""
    rows: list[Transition] = []
    versions: list[int] = []
    before: Segment | None = None
    for number, segment in enumerate(segments):
        assert segment.sequence == number
        assert segment.span.dtype == np.uint8
        carried = segment.carried if before else 0
        assert segment.carried == carried
        if before:
            np.testing.assert_array_equal(segment.frames[:carried], before.frames[len(before.frames) - carried :])
        obs, led = segment.frames[segment.obs_index[:, 0], 0], segment.frames[segment.next_index[:, 0], 0]
        columns = (obs, segment.rewards, led, segment.terminated, segment.span)
        rows += zip(*(column.tolist() for column in columns), strict=True)
        versions += segment.param_version.tolist()
        assert segment.actions.tolist() == [version % 2 for version in segment.param_version]
        for end in segment.episodes:
            assert segment.param_version[end.step_in_segment] == end.episode_return, "the step that ended it"
        before = segment
    assert versions == list(range(len(rows))), "one transition for each step, in order"
    return rows


def brute_force(rewards: list[float], kinds: list[int], n: int) -> list[Transition]:
    """What Algorithm 1 with n-step returns would store, one step at a time; what is not complete is left out."""
    rows: list[Transition] = []
    for t in range(len(rewards)):
        total, k, kind = 0.0, 0, GOES_ON
        while k < n and kind == GOES_ON:
            if t + k == len(rewards):
                return rows
            total += GAMMA**k * rewards[t + k]
            kind = kinds[t + k]
            k += 1
        obs = t + 0.5 if t and kinds[t - 1] >= TERMINAL else float(t)
        rows.append((obs, total, float(t + k), kind in (LIFE_LOST, TERMINAL), k))
    return rows


G, L, E, C = GOES_ON, LIFE_LOST, TERMINAL, TRUNCATED


@pytest.mark.parametrize(
    ("rewards", "ends", "n", "expected"),
    [
        # obs, return, next obs, terminated, span
        ([1, 2], [G, G], 1, [(0, 1, 1, False, 1), (1, 2, 2, False, 1)]),
        ([1, 2, 4], [G, G, G], 2, [(0, 2, 2, False, 2), (1, 4, 3, False, 2)]),
        ([1, 2, 4], [G, G, G], 3, [(0, 3, 3, False, 3)]),
        ([1, 2, 4], [G, G, G], 4, []),
        ([1, 2, 4], [G, G, E], 3, [(0, 3, 3, True, 3), (1, 4, 3, True, 2), (2, 4, 3, True, 1)]),
        ([1, 2, 4], [G, G, C], 5, [(0, 3, 3, False, 3), (1, 4, 3, False, 2), (2, 4, 3, False, 1)]),
        (
            [1, 2, 4, 8],
            [G, L, G, C],
            3,
            [(0, 2, 2, True, 2), (1, 2, 2, True, 1), (2, 8, 4, False, 2), (3, 8, 4, False, 1)],
        ),
        ([1, 2, 4], [E, C, G], 2, [(0, 1, 1, True, 1), (1.5, 2, 2, False, 1)]),
    ],
)
def test_by_hand(rewards: list[float], ends: list[int], n: int, expected: list[Transition]) -> None:
    for segment_steps in (1, 2, 50):
        assert transitions(play(rewards, ends, n, segment_steps)) == expected
    assert brute_force(rewards, ends, n) == expected


@given(
    steps=st.lists(st.tuples(st.integers(-3, 3), st.sampled_from([G, G, G, G, L, E, C])), min_size=1, max_size=40),
    n=st.integers(1, 8),
    segment_steps=st.integers(1, 12),
    flush_at=st.integers(-1, 40),
)
@settings(max_examples=200, deadline=None)
def test_any_ends_and_cuts(steps: list[tuple[int, int]], n: int, segment_steps: int, flush_at: int) -> None:
    rewards, kinds = [float(reward) for reward, _ in steps], [kind for _, kind in steps]
    segments = play(rewards, kinds, n, segment_steps, flush_at)
    assert transitions(segments) == brute_force(rewards, kinds, n)
    assert all(segment.steps <= segment_steps + n - 1 for segment in segments)


@pytest.mark.parametrize("eviction", ["fifo", "reservoir", "prioritized"])
@pytest.mark.parametrize(("n", "segment_steps"), [(3, 1), (5, 4), (4, 16)])
def test_a_table_holds_what_brute_force_would(eviction: str, n: int, segment_steps: int) -> None:
    """Whatever is evicted, what is held is exact; and no frame is stored twice for being carried."""
    rng = np.random.default_rng(4)
    rewards = rng.integers(-3, 4, 300).astype(float).tolist()
    kinds = rng.choice([G, L, E, C], 300, p=[0.88, 0.04, 0.04, 0.04]).tolist()
    table = Table(SPEC, 40, eviction=eviction, rng=np.random.default_rng(1))
    for segment in play(rewards, kinds, n, segment_steps):
        table.insert(segment)
    expected = brute_force(rewards, kinds, n)
    assert table.inserted == len(expected)
    batch = table.sample(500)
    held = set()
    for i, number in enumerate(batch.ids.tolist()):
        obs, led = batch.frames[batch.obs_index[i, 0], 0], batch.frames[batch.next_index[i, 0], 0]
        row = (obs, batch.rewards[i], led, batch.terminated[i], batch.span[i])
        assert row == expected[number]
        held.add(number)
    assert len(held) == 40
    frames = {name for number in held for name in (expected[number][0], expected[number][2])}
    assert table_stats(table).frames_held <= len(frames) + n + 1


def test_several_streams_wait_each_for_itself() -> None:
    """Stream 1's episode ends with each step, so that it never waits; stream 0's never ends."""
    assembler = SegmentAssembler(SPEC, 2, INCARNATION, 2, n_step=4, gamma=GAMMA)
    assembler.begin(np.zeros((2, 1), np.float32))
    sent = []
    for t in range(1, 7):
        led, over = np.full((2, 1), t, np.float32), np.array([False, True])
        took = Steps(led, led, np.ones(2, np.float32), np.ones(2), over, over, over)
        sent += [(s.stream, s.sequence, s.span.tolist()) for s in assembler.add(np.zeros(2, np.int32), took, 0, {})]
    assert sent == [(1, 0, [1, 1]), (0, 0, [4]), (1, 1, [1, 1]), (0, 1, [4, 4]), (1, 2, [1, 1])]


def test_spans_survive_the_wire_and_a_snapshot() -> None:
    spec = make_spec(1)
    span = np.array([3, 3, 2, 1], np.uint8)
    segment = msgspec.structs.replace(Stream(spec, 0, np.random.default_rng(0), 10).segment(4), span=span)
    read = SegmentReader(spec)(wire.decode(bytes(encode_segment("run", segment))))
    assert read.span.tolist() == span.tolist()
    table, again = (Table(spec, 10, rng=np.random.default_rng(1)) for _ in range(2))
    table.insert(read)
    again.load_state(*whole_state(table))
    batch = again.sample(64)
    assert batch.span.tolist() == span[batch.ids].tolist()
