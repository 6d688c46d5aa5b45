"""The table against a list of copies, through random episodes, segment cuts, losses and policies."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UsageError
from common.types import Array, Batch, EnvSpec, Segment
from replay import table as table_module
from replay.selection import EVICTIONS, SAMPLINGS
from replay.stats import estimated_bytes
from replay.table import Table


def make_spec(stack: int, dtype: str = "float32", shape: tuple[int, ...] = (2, 3)) -> EnvSpec:
    return EnvSpec("test", shape, dtype, stack, 5)


@dataclass
class Stream:
    """An emulator and its actor: every frame is unlike all others, segments carry what the last one ended with."""

    spec: EnvSpec
    number: int
    rng: np.random.Generator
    episode_length: int
    sequence: int = 0
    clock: int = 0
    observation: list[int] = field(default_factory=list)  # frames are named by numbers
    sent: list[int] = field(default_factory=list)  # the frames of the last segment

    def frame(self, name: int) -> Array:
        values = np.random.default_rng([self.number, name])
        if self.spec.frame_dtype == "uint8":
            return values.integers(0, 256, self.spec.frame_shape, np.uint8)
        return values.random(self.spec.frame_shape, np.float32)

    def new_frame(self) -> int:
        self.clock += 1
        return self.clock

    def segment(self, steps: int) -> Segment:
        pairs, terminated = [], []
        for _ in range(steps):
            if not self.observation:
                self.observation = [self.new_frame()] * self.spec.stack
            following = [*self.observation[1:], self.new_frame()]
            pairs.append((self.observation, following))
            terminated.append(bool(self.rng.random() < 0.5 / self.episode_length))
            ended = terminated[-1] or self.rng.random() < 0.5 / self.episode_length
            self.observation = [] if ended else following
        names = sorted({name for pair in pairs for obs in pair for name in obs})
        place = {name: index for index, name in enumerate(names)}
        carried = sum(name in self.sent for name in names)
        assert self.sent[len(self.sent) - carried :] == names[:carried]
        self.sent = names
        self.sequence += 1
        index = np.array([[[place[name] for name in obs] for obs in pair] for pair in pairs], np.int32)
        return Segment(
            incarnation=7,
            stream=self.number,
            sequence=self.sequence - 1,
            frames=np.stack([self.frame(name) for name in names]),
            obs_index=np.ascontiguousarray(index[:, 0]),
            next_index=np.ascontiguousarray(index[:, 1]),
            actions=self.rng.integers(0, 5, steps, np.int32),
            rewards=self.rng.random(steps, np.float32),
            terminated=np.array(terminated),
            param_version=self.rng.integers(0, 1 << 40, steps),
            carried=carried,
        )


@dataclass
class Copies:
    """The same table done the naive way: a copy of both stacks per transition, one transition at a time."""

    capacity: int
    eviction: str
    held: dict[int, tuple[Any, ...]] = field(default_factory=dict)
    row: dict[int, int] = field(default_factory=dict)
    priority: dict[int, float] = field(default_factory=dict)
    draws: dict[int, int] = field(default_factory=dict)
    max_priority: float = 1.0
    inserted: int = 0
    evicted_unsampled: int = 0

    def insert(self, segment: Segment, rng: np.random.Generator) -> None:
        for step in range(segment.steps):
            number, self.inserted = self.inserted, self.inserted + 1
            victim, row = None, number
            if number >= self.capacity:
                row = int(rng.integers(0, number + 1)) if self.eviction == "reservoir" else -1
                if self.eviction == "fifo":
                    victim = min(self.held)
                elif self.eviction == "prioritized":
                    victim = min(self.held, key=lambda number: (self.priority[number], number))
                else:
                    victim = next((held for held in self.held if self.row[held] == row), None)
            if victim is not None:
                del self.held[victim]
                self.evicted_unsampled += victim not in self.draws
            if number >= self.capacity and victim is None:
                self.evicted_unsampled += 1
                continue
            self.row[number] = row
            self.priority[number] = self.max_priority
            self.held[number] = (
                segment.frames[segment.obs_index[step]].copy(),
                segment.frames[segment.next_index[step]].copy(),
                segment.actions[step],
                segment.rewards[step],
                segment.terminated[step],
                segment.param_version[step],
            )

    def update(self, ids: Array, priorities: Array) -> None:
        for number, priority in zip(ids.tolist(), priorities.tolist(), strict=True):
            if number in self.held:
                self.priority[number] = priority
                self.max_priority = max(self.max_priority, priority)

    def check(self, batch: Batch) -> None:
        for number in batch.ids.tolist():
            self.draws[number] = self.draws.get(number, 0) + 1
        for row, number in enumerate(batch.ids.tolist()):
            obs, following, action, reward, terminated, version = self.held[number]
            np.testing.assert_array_equal(batch.frames[batch.obs_index[row]], obs)
            np.testing.assert_array_equal(batch.frames[batch.next_index[row]], following)
            assert (batch.actions[row], batch.rewards[row]) == (action, reward)
            assert (batch.terminated[row], batch.param_version[row]) == (terminated, version)
            assert batch.age[row] == self.inserted - 1 - number
            assert batch.reuse[row] == self.draws[number]


def held_ids(table: Table) -> list[int]:
    return sorted(table._ids[: len(table)].tolist())


def check_references(table: Table, pinned: Array | None = None) -> None:
    """Every slot has exactly the references of the transitions, streams and snapshots that name it."""
    named: list[Array] = [tail[tail >= 0] for _, tail in table._tails.values()]
    named += [table._slots[: len(table)].reshape(-1), *([] if pinned is None else [pinned])]
    references = table._frames.references
    expected = np.bincount(np.concatenate(named).astype(np.intp), minlength=len(references))
    np.testing.assert_array_equal(references, expected)
    assert table._frames.held == np.count_nonzero(references)


def assert_same(one: Batch, other: Batch) -> None:
    for name in Batch.__slots__:
        a, b = getattr(one, name), getattr(other, name)
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, err_msg=name)


cases = st.fixed_dictionaries(
    {
        "capacity": st.integers(1, 40),
        "stack": st.integers(1, 4),
        "dtype": st.sampled_from(["uint8", "float32"]),
        "eviction": st.sampled_from(EVICTIONS),
        "sampling": st.sampled_from(SAMPLINGS),
        "streams": st.integers(1, 3),
        "episode_length": st.sampled_from([1, 5, 50]),
        "seed": st.integers(0, 10_000),
    }
)
# What happens next: a segment of n steps arrives, is lost on the way, or a batch of n is drawn.
events = st.lists(
    st.tuples(st.sampled_from(["insert", "insert", "insert", "lose", "sample"]), st.integers(1, 20)),
    min_size=5,
    max_size=60,
)


def play(case: dict[str, Any], steps: list[tuple[str, int]]) -> Iterator[tuple[Table, Copies, list[Stream]]]:
    """Let table and copies live through the same events; yield them after each."""
    spec = make_spec(case["stack"], case["dtype"])
    rng = np.random.default_rng(case["seed"])
    table = Table(
        spec, case["capacity"], eviction=case["eviction"], sampling=case["sampling"], rng=np.random.default_rng(1)
    )
    copies = Copies(case["capacity"], case["eviction"])
    streams = [Stream(spec, number, rng, case["episode_length"]) for number in range(case["streams"])]
    for event, count in steps:
        if event == "sample" and len(table):
            batch = table.sample(count)
            copies.check(batch)
            priorities = rng.integers(0, 4, count) / 2  # few values: ties must be broken alike
            ids = batch.ids - rng.integers(0, 3, count)  # some are not held
            table.update_priorities(ids, priorities)
            copies.update(ids, priorities)
        elif event != "sample":
            segment = streams[int(rng.integers(len(streams)))].segment(count)
            if event == "insert":
                copies.insert(segment, copy.deepcopy(table._rng))
                table.insert(segment)
        yield table, copies, streams


@settings(max_examples=200, deadline=None)
@given(case=cases, steps=events)
def test_equals_a_list_of_copies(case: dict[str, Any], steps: list[tuple[str, int]]) -> None:
    for table, copies, _ in play(case, steps):
        assert len(table) == min(copies.inserted, case["capacity"])
        assert held_ids(table) == sorted(copies.held)
        check_references(table)
        stats = table.stats()
        assert stats.evicted_unsampled == copies.evicted_unsampled
        assert stats.evicted == stats.inserted - stats.size == sum(stats.reuse_evicted)
        assert sum(stats.reuse_held) == stats.size


@settings(max_examples=60, deadline=None)
@given(case=cases, steps=events, tail=events)
def test_restored_table_continues_to_the_bit(
    case: dict[str, Any], steps: list[tuple[str, int]], tail: list[tuple[str, int]]
) -> None:
    *_, (table, _, streams) = play(case, steps)
    meta, arrays = table.state()
    meta = msgpack.unpackb(msgpack.packb(meta))
    arrays = {name: array.copy() for name, array in arrays.items()}
    spec = make_spec(case["stack"], case["dtype"])
    twin = Table(
        spec, case["capacity"], eviction=case["eviction"], sampling=case["sampling"], rng=np.random.default_rng(2)
    )
    twin.load_state(meta, arrays)
    check_references(twin)
    # Only the restored one has no trace of frames that are gone.
    assert replace(twin.stats(), bytes_held=0) == replace(table.stats(), bytes_held=0)
    rng = np.random.default_rng(3)
    for event, count in tail:
        if event == "insert":
            segment = streams[int(rng.integers(len(streams)))].segment(count)
            table.insert(segment)
            twin.insert(segment)
            assert twin.stats().frames_held == table.stats().frames_held
        elif len(table):
            batch = table.sample(count)
            assert_same(batch, twin.sample(count))
            for one in (table, twin):
                one.update_priorities(batch.ids, batch.rewards)
        assert held_ids(table) == held_ids(twin)
    check_references(twin)


@pytest.mark.parametrize("stack", [1, 4])
def test_each_frame_is_held_once(stack: int) -> None:
    """Through segment borders and eviction, with every segment delivered, only frames in use are held."""
    streams = [Stream(make_spec(stack), number, np.random.default_rng(number), 20) for number in range(3)]
    table = Table(make_spec(stack), 50, rng=np.random.default_rng(0))
    sent: list[set[tuple[int, int]]] = []
    for turn in range(60):
        stream = streams[turn % 3]
        segment = stream.segment(5)
        table.insert(segment)
        sent += [
            {(stream.number, stream.sent[place]) for place in (*now, *following)}
            for now, following in zip(segment.obs_index.tolist(), segment.next_index.tolist(), strict=True)
        ]
        last = {(one.number, name) for one in streams for name in one.sent[-stack:]}
        assert table.stats().frames_held == len(set().union(last, *sent[-50:]))


@settings(max_examples=60, deadline=None)
@given(case=cases, steps=events, tail=events)
def test_snapshot_stays_while_the_table_goes_on(
    case: dict[str, Any], steps: list[tuple[str, int]], tail: list[tuple[str, int]]
) -> None:
    *_, (table, _, streams) = play(case, steps)
    _, then = table.state()
    _, arrays, frames = table.snapshot()
    with frames:
        check_references(table, frames._slots)
        for event, count in tail:
            if event == "sample" and len(table):
                table.sample(count)
            else:
                table.insert(streams[0].segment(count))
        half = len(frames) // 2
        copied = np.concatenate([frames.read(0, half), frames.read(half, len(frames))])
        for name, array in {**arrays, "frames": copied}.items():
            np.testing.assert_array_equal(array, then[name], err_msg=name)
        check_references(table, frames._slots)
    check_references(table)


def test_n_step_transitions_carry_more_than_a_stack() -> None:
    """A segment whose observations reach further back than one stack still shares what the stream kept."""
    table = Table(make_spec(2), 100, rng=np.random.default_rng(0))
    names = np.arange(40)
    for sequence in range(4):
        window = names[6 * sequence : 6 * sequence + 10]  # 4 carried frames, then 6 new ones
        start = np.arange(6)[:, None] + np.arange(2)
        table.insert(
            Segment(
                incarnation=1,
                stream=0,
                sequence=sequence,
                frames=np.broadcast_to(window[:, None, None], (10, 2, 3)).astype(np.float32),
                obs_index=start.astype(np.int32),
                next_index=(start + 3).astype(np.int32),
                actions=np.zeros(6, np.int32),
                rewards=np.zeros(6, np.float32),
                terminated=np.zeros(6, np.bool_),
                param_version=np.zeros(6, np.int64),
                carried=4 if sequence else 0,
            )
        )
    # The first border shares one stack of two, as no more was expected then; the others share all four.
    assert table.stats().frames_held == 10 + 8 + 6 + 6
    batch = table.sample(200)
    first = batch.frames[batch.obs_index][:, :, 0, 0]
    np.testing.assert_array_equal(batch.frames[batch.next_index][:, :, 0, 0], first + 3)


def test_streams_used_least_recently_give_their_frames_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_module, "MAX_STREAMS", 3)
    table = Table(make_spec(2), 4, rng=np.random.default_rng(0))
    for number in range(10):
        table.insert(Stream(make_spec(2), number, np.random.default_rng(0), 50).segment(4))
        check_references(table)
    assert [stream for _, stream in table._tails] == [7, 8, 9]
    assert table.stats().frames_held == 5 + 2 * 2


def test_a_batch_has_each_frame_once() -> None:
    table = Table(make_spec(4), 10, rng=np.random.default_rng(0))
    table.insert(Stream(make_spec(4), 0, np.random.default_rng(0), 50).segment(10))
    for _ in range(3):
        batch = table.sample(64)
        assert len(np.unique(batch.frames, axis=0)) == len(batch.frames) <= 11 + 3
        assert (batch.obs_index.dtype.name, batch.obs_index.shape) == ("int32", (64, 4))
        assert (batch.next_index.dtype.name, batch.next_index.shape) == ("int32", (64, 4))
        assert batch.obs_index.flags.c_contiguous
        assert batch.next_index.flags.c_contiguous
        np.testing.assert_array_equal(batch.weights, np.ones(64, np.float32))


def test_reuse_histograms() -> None:
    table = Table(make_spec(1), 2, rng=np.random.default_rng(0))
    stream = Stream(make_spec(1), 0, np.random.default_rng(0), 50)
    table.insert(stream.segment(2))
    draws = np.bincount(table.sample(7).ids, minlength=2)
    stats = table.stats()
    assert (stats.batches, stats.sampled, stats.reuse_mean) == (1, 7, 3.5)
    assert stats.reuse_held == tuple(np.bincount([int(n).bit_length() for n in draws], minlength=16))
    table.insert(stream.segment(1))
    assert table.stats().reuse_evicted[int(draws[0]).bit_length()] == 1
    table.insert(stream.segment(2))
    assert table.stats().evicted_unsampled == 1


def test_estimate_covers_a_full_table() -> None:
    spec = make_spec(4, "uint8", (84, 84))
    table = Table(spec, 500, rng=np.random.default_rng(0))
    stream = Stream(spec, 0, np.random.default_rng(0), 10**9)
    for _ in range(20):
        table.insert(stream.segment(50))
    assert table.stats().bytes_held <= 1.05 * estimated_bytes(spec, 500)
    assert estimated_bytes(spec, 10**6) < 7300 * 10**6


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"capacity": 0}, "capacity: 0"),
        ({"eviction": "lifo"}, "eviction: 'lifo' is not one of fifo"),
        ({"sampling": "best"}, "sampling: 'best' is not one of uniform"),
        ({"priority_exponent": -1.0}, "priority_exponent"),
        ({"importance_exponent": float("nan")}, "importance_exponent"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        Table(make_spec(1), **{"capacity": 10, "rng": np.random.default_rng(0), **settings})


def test_misuse_is_refused() -> None:
    table = Table(make_spec(1), 10, sampling="prioritized", rng=np.random.default_rng(0))
    with pytest.raises(ValueError, match="empty"):
        table.sample(1)
    table.insert(Stream(make_spec(1), 0, np.random.default_rng(0), 50).segment(10))
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="priorities"):
            table.update_priorities(np.array([1, 2]), np.array([1.0, bad]))
    with pytest.raises(ValueError, match="priorities"):
        table.update_priorities(np.array([1, 2]), np.array([1.0]))
    meta, arrays = table.state()
    with pytest.raises(ValueError, match="new table"):
        table.load_state(meta, arrays)
    with pytest.raises(UsageError, match="capacity: 11, but the saved table had 10"):
        Table(make_spec(1), 11, sampling="prioritized", rng=np.random.default_rng(0)).load_state(meta, arrays)
