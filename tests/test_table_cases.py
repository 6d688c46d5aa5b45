"""Single cases of the table: sharing of frames, bounds, diagnostics, and what is refused."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from samples import make_segment
from table_reference import Copies, Stream, check_references, make_spec, table_stats, whole_state

from coop.common.errors import UsageError
from coop.common.settings.capacity import estimated_bytes
from coop.common.transitions import Segment
from coop.common.types import EnvSpec
from coop.replay.table import streams
from coop.replay.table.loops import reuse_histogram
from coop.replay.table.table import Table


def test_terminal_transitions_are_counted_as_they_come_and_go(spec: EnvSpec) -> None:
    """Two segments wrap around a table of five; a third is longer than the table, which keeps its last five."""
    table = Table(spec, 5, rng=np.random.default_rng(0))
    counts = []
    for sequence, ends in enumerate(([1, 0, 1], [0, 1, 1], [0, 0, 1, 0, 0, 0, 1])):
        table.insert(make_segment(spec, sequence, len(ends), terminated=np.array(ends, np.bool_), carried=0))
        counts.append(table.terminal)
    assert counts == [2, 3, 2]  # of 101, 01011 and 10001
    restored = Table(spec, 5, rng=np.random.default_rng(0))
    restored.load_state(*whole_state(table))
    assert restored.terminal == 2


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
        assert table_stats(table).frames_held == len(set().union(last, *sent[-50:]))


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
                span=np.ones(6, np.uint8),
                carried=4 if sequence else 0,
            )
        )
    # The first border shares one stack of two, as no more was expected then; the others share all four.
    assert table_stats(table).frames_held == 10 + 8 + 6 + 6
    batch = table.sample(200)
    first = batch.frames[batch.obs_index][:, :, 0, 0]
    np.testing.assert_array_equal(batch.frames[batch.next_index][:, :, 0, 0], first + 3)


def test_streams_used_least_recently_give_their_frames_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "MAX_STREAMS", 3)
    table = Table(make_spec(2), 4, rng=np.random.default_rng(0))
    for number in range(10):
        table.insert(Stream(make_spec(2), number, np.random.default_rng(0), 50).segment(4))
        check_references(table)
    assert [stream for _, stream, *_ in table._tails.streams()] == [7, 8, 9]
    assert table_stats(table).frames_held == 5 + 2 * 2


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has the memory that is shared")
def test_frames_are_shared_only_where_that_is_asked_for(spec: EnvSpec) -> None:
    assert Table(spec, 5, rng=np.random.default_rng(0)).shared_memory == ""
    assert Table(spec, 5, rng=np.random.default_rng(0), shared_memory=True).shared_memory != ""


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
    stats = table_stats(table)
    assert (stats.batches, stats.sampled, stats.reuse_mean) == (1, 7, 3.5)
    assert stats.reuse_held == tuple(np.bincount([int(n).bit_length() for n in draws], minlength=16))
    table.insert(stream.segment(1))
    assert table_stats(table).reuse_evicted[int(draws[0]).bit_length()] == 1
    table.insert(stream.segment(2))
    assert table_stats(table).evicted_unsampled == 1
    table.sample(3)
    stats = table_stats(table)
    assert (stats.batches, stats.sampled) == (2, 10)
    assert {type(count) for count in stats.reuse_evicted} == {int}


def test_the_last_bucket_is_open() -> None:
    histogram = reuse_histogram(np.array([0, 1, 2, 3, 4, 2**14, 2**15, 2**31 - 1], np.int32))
    assert histogram.tolist() == [1, 1, 2, 1, *[0] * 11, 3]


@pytest.mark.parametrize("eviction", ["reservoir", "prioritized"])
def test_no_row_is_remembered_of_what_has_gone(eviction: str) -> None:
    table = Table(make_spec(1), 4, eviction=eviction, sampling="prioritized", rng=np.random.default_rng(0))
    stream = Stream(make_spec(1), 0, np.random.default_rng(0), 50)
    for _ in range(20):
        table.insert(stream.segment(3))
    assert table._row_of is not None
    assert len(table._row_of) == len(table) == 4


@pytest.mark.parametrize("eviction", ["fifo", "reservoir", "prioritized"])
def test_priorities_of_evicted_transitions_are_ignored(eviction: str) -> None:
    table = Table(make_spec(1), 4, eviction=eviction, sampling="prioritized", rng=np.random.default_rng(0))
    stream = Stream(make_spec(1), 0, np.random.default_rng(0), 50)
    table.insert(stream.segment(40))
    held = set(table.sample(100).ids.tolist())
    gone = np.array(sorted(set(range(-4, 50)) - held))
    table.update_priorities(gone, np.full(len(gone), 1e9))
    assert table._columns.priorities.tolist() == [1.0] * 4
    table.insert(stream.segment(1))
    assert table._columns.priorities.tolist() == [1.0] * 4


def test_priorities_of_what_has_not_come_yet_are_ignored() -> None:
    table = Table(make_spec(1), 4, sampling="prioritized", rng=np.random.default_rng(0))
    table.update_priorities(np.array([0]), np.array([9.0]))
    table.insert(Stream(make_spec(1), 0, np.random.default_rng(0), 50).segment(2))
    assert table._columns.priorities[:2].tolist() == [1.0, 1.0]


def test_priorities_count_in_double_precision() -> None:
    found = []
    for dtype in (np.float32, np.float64):
        table = Table(make_spec(1), 4, sampling="prioritized", rng=np.random.default_rng(0))
        table.insert(Stream(make_spec(1), 0, np.random.default_rng(0), 50).segment(4))
        table.update_priorities(np.arange(4), np.array([0.1, 0.2, 0.3, 0.7], np.float32).astype(dtype))
        sampling: Any = table._sampling
        found.append(sampling._tree.values(np.arange(4)))
    np.testing.assert_array_equal(*found)


def test_priorities_find_a_transition_in_whatever_row_it_is() -> None:
    table = Table(make_spec(1), 2, eviction="prioritized", rng=np.random.default_rng(0))
    stream = Stream(make_spec(1), 0, np.random.default_rng(0), 50)
    table.insert(stream.segment(2))
    table.update_priorities(np.array([0, 1]), np.array([9.0, 0.1]))
    table.insert(stream.segment(1))  # in the place of 1
    table.update_priorities(np.empty(0, np.int64), np.empty(0, np.float32))
    table.update_priorities(np.array([2]), np.array([0.5]))
    table.insert(stream.segment(1))
    assert set(table.sample(100).ids.tolist()) == {0, 3}


def test_frames_survive_growth() -> None:
    """More frames than the store begins with: those written before it grew are still the same."""
    table = Table(make_spec(2), 3000, rng=np.random.default_rng(0))
    stream = Stream(make_spec(2), 0, np.random.default_rng(0), 50)
    copies = Copies(3000, "fifo")
    for _ in range(40):
        segment = stream.segment(100)
        table.insert(segment)
        copies.insert(segment, np.random.default_rng(0))
        check_references(table)
    copies.check(table.sample(1000))


def test_estimate_covers_a_full_table() -> None:
    spec = make_spec(4, "uint8", (84, 84))
    table = Table(spec, 500, rng=np.random.default_rng(0))
    stream = Stream(spec, 0, np.random.default_rng(0), 10**9)
    for _ in range(20):
        table.insert(stream.segment(50))
    assert table_stats(table).bytes_held <= 1.05 * estimated_bytes(spec, 500)
    assert estimated_bytes(spec, 10**6) < 7300 * 10**6


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"capacity": 0}, "capacity: 0"),
        ({"eviction": "lifo"}, "replay.eviction = 'lifo': unknown; did you mean fifo\\? allowed: fifo, reservoir"),
        ({"sampling": "best"}, "replay.sampling = 'best': unknown; allowed: uniform, prioritized"),
        ({"sampling": "prioritized", "replacement": False}, "sampling: 'prioritized' draws with replacement only"),
        ({"priority_exponent": -1.0}, "priority_exponent"),
        ({"importance_exponent": float("nan")}, "importance_exponent"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        Table(make_spec(1), **{"capacity": 10, "rng": np.random.default_rng(0), **settings})


def test_exponents_of_0_make_priorities_irrelevant() -> None:
    settings = {"sampling": "prioritized", "priority_exponent": 0.0, "importance_exponent": 0.0}
    table = Table(make_spec(1), 2, rng=np.random.default_rng(0), **settings)  # type: ignore[arg-type]
    table.insert(Stream(make_spec(1), 0, np.random.default_rng(0), 50).segment(2))
    table.update_priorities(np.array([0, 1]), np.array([0.0, 1e6]))
    batch = table.sample(10)
    assert np.bincount(batch.ids).tolist() == [5, 5]
    assert batch.weights.tolist() == [1.0] * 10


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
    meta, arrays = whole_state(table)
    with pytest.raises(ValueError, match="new table"):
        table.load_state(meta, arrays)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"capacity": 11}, "capacity: 11, but the saved table had 10"),
        ({"eviction": "reservoir"}, "eviction: 'reservoir', but the saved table had 'fifo'"),
        ({"sampling": "uniform"}, "sampling: 'uniform', but the saved table had 'prioritized'"),
        ({"priority_exponent": 0.5}, "priority_exponent: 0.5, but the saved table had 0.6"),
        ({"importance_exponent": 0.5}, "importance_exponent: 0.5, but the saved table had 0.4"),
        ({"spec": make_spec(2)}, r"spec: \['test', .*2, 5\], but the saved table had \['test', .*1, 5\]"),
        (
            {"spec": replace(make_spec(1), masks=True)},
            r"spec: \['test', .*1, 5, True\], but the saved table had \['test', .*1, 5\]",
        ),
    ],
)
def test_a_table_of_other_settings_is_not_restored(change: dict[str, Any], words: str) -> None:
    settings: dict[str, Any] = {"spec": make_spec(1), "capacity": 10, "sampling": "prioritized"}
    state = whole_state(Table(**settings, rng=np.random.default_rng(0)))
    with pytest.raises(UsageError, match=f"^{words}$"):
        Table(**{**settings, **change}, rng=np.random.default_rng(0)).load_state(*state)


def test_a_state_of_many_frames() -> None:
    table = Table(make_spec(2), 3000, rng=np.random.default_rng(0))
    stream = Stream(make_spec(2), 0, np.random.default_rng(0), 50)
    for _ in range(30):
        table.insert(stream.segment(100))
    meta, arrays = whole_state(table)
    assert len(arrays["frames"]) > 3000
    twin = Table(make_spec(2), 3000, rng=np.random.default_rng(1))
    twin.load_state(meta, arrays)
    check_references(twin)
    one, other = table.sample(500), twin.sample(500)
    for index in ("obs_index", "next_index"):
        np.testing.assert_array_equal(one.frames[getattr(one, index)], other.frames[getattr(other, index)])


def test_a_table_of_one_transition() -> None:
    table = Table(make_spec(1), 1, rng=np.random.default_rng(0))
    table.insert(Stream(make_spec(1), 0, np.random.default_rng(0), 50).segment(3))
    assert table.sample(2).ids.tolist() == [2, 2]


def test_a_state_tells_which_frames_the_next_segment_may_repeat() -> None:
    table = Table(make_spec(2), 5, rng=np.random.default_rng(0))
    segment = Stream(make_spec(2), 0, np.random.default_rng(0), 50).segment(1)
    table.insert(replace(segment, span=np.full(1, 3, np.uint8)))
    meta, arrays = whole_state(table)
    assert (arrays["tails"].tolist(), arrays["tails"].dtype) == ([0, 1], np.int32)
    twin = Table(make_spec(2), 5, rng=np.random.default_rng(0))
    twin.load_state(meta, arrays)
    check_references(twin)
    assert twin.sample(1).span.tolist() == [3]
    few = Table(make_spec(1), 1, eviction="reservoir", rng=np.random.default_rng(0))
    few.insert(Stream(make_spec(1), 0, np.random.default_rng(0), 50).segment(40))
    _, arrays = whole_state(few)
    assert arrays["tails"].tolist() == [-1]  # its transition is not held
    assert arrays["priorities"].size == 0


def test_types_of_a_batch() -> None:
    table = Table(make_spec(1), 10, rng=np.random.default_rng(0))
    table.insert(Stream(make_spec(1), 0, np.random.default_rng(0), 50).segment(4))
    batch = table.sample(3)
    types = {name: array.dtype.name for name, array in {"frames": batch.frames, **batch.columns()}.items()}
    assert types == {
        **{"frames": "float32", "obs_index": "int32", "next_index": "int32", "actions": "int32", "rewards": "float32"},
        **{"terminated": "bool", "span": "uint8", "weights": "float32", "ids": "int64", "param_version": "int64"},
        **{"age": "int64", "reuse": "int32"},
    }


@pytest.mark.parametrize(("sampling", "row"), [("uniform", 38), ("prioritized", 46)])
def test_bytes_of_transitions(sampling: str, row: int) -> None:
    """Two slots, action, reward, end, span, version, number and draws: 8 + 4 + 4 + 1 + 1 + 8 + 8 + 4; 8 a priority."""
    table = Table(make_spec(1), 10, sampling=sampling, rng=np.random.default_rng(0))
    empty = table_stats(table)
    assert (empty.size, empty.bytes_held, empty.reuse_mean) == (0, table._frames.bytes_held, 0.0)
    table.insert(Stream(make_spec(1), 0, np.random.default_rng(0), 50).segment(4))
    held = table_stats(table).bytes_held
    assert (held, type(held)) == (table._frames.bytes_held + 4 * row, int)


def test_what_has_come_in_twice_is_counted() -> None:
    """Draws, priority and version may differ, the content not."""
    spec = EnvSpec("x", (4,), "float32", 1, 2)
    table = Table(spec, 50, sampling="prioritized", rng=np.random.default_rng(0))
    for sequence in range(3):
        table.insert(make_segment(spec, sequence))
    assert table.repeated() == 0
    table.sample(5)
    table.update_priorities(np.arange(12), np.arange(12.0))
    table.insert(make_segment(spec, 1, incarnation=8, param_version=np.full(4, 9)))
    assert table.repeated() == 4
    differences: list[dict[str, object]] = [
        {"actions": np.ones(4, np.int32)},
        {"rewards": np.full(4, -1.0, np.float32)},
        {"terminated": np.ones(4, np.bool_)},
        {"span": np.full(4, 2, np.uint8)},
        {"frames": np.zeros((5, 4), np.float32), "carried": 0},
    ]
    for number, change in enumerate(differences):
        table.insert(make_segment(spec, 2, incarnation=10 + number, **change))  # type: ignore[arg-type]
    assert (len(table), table.repeated()) == (36, 4)


def test_preloaded_transitions_count_neither_as_inserted_nor_as_evicted(spec: EnvSpec) -> None:
    table = Table(spec, 5, rng=np.random.default_rng(0))
    for sequence in range(2):
        table.preload(make_segment(spec, sequence))
        table.sample(9)
    assert (len(table), table.preloaded, table.inserted, table.numbered) == (5, 8, 0, 8)
    assert table_stats(table).reuse_evicted == (0,) * 16
    assert (table.evicted, table.evicted_unsampled) == (0, 0)
    restored = Table(spec, 5, rng=np.random.default_rng(0))
    restored.load_state(*whole_state(table))
    for one in (table, restored):
        one.insert(make_segment(spec, 2, steps=1, carried=0))
        batch = one.sample(99)
        assert sorted(set(batch.ids.tolist())) == [4, 5, 6, 7, 8]
        np.testing.assert_array_equal(batch.age, 8 - batch.ids)
        assert (one.preloaded, one.inserted, one.evicted, sum(table_stats(one).reuse_evicted)) == (8, 1, 1, 1)
        with pytest.raises(ValueError, match="without transitions of the run"):
            one.preload(make_segment(spec, 3))


def test_the_checksum_of_what_is_preloaded_is_of_all_fields_and_segments(spec: EnvSpec) -> None:
    changes: list[dict[str, object]] = [
        {},
        {"frames": np.ones((5, 4), np.float32)},
        {"actions": np.ones(4, np.int32)},
        {"rewards": np.ones(4, np.float32)},
        {"terminated": np.ones(4, np.bool_)},
        {"span": np.full(4, 2, np.uint8)},
    ]
    sums = set()
    for change in changes:
        one, other = (Table(spec, 20, rng=np.random.default_rng(0)) for _ in range(2))
        for table in (one, other):
            assert table.preload_sum == 0
            table.preload(make_segment(spec, 0, **change))  # type: ignore[arg-type]
            table.preload(make_segment(spec, 1))
        assert one.preload_sum == other.preload_sum
        sums.add(one.preload_sum)
        restored = Table(spec, 20, rng=np.random.default_rng(0))
        restored.load_state(*whole_state(one))
        assert restored.preload_sum == one.preload_sum
    assert len(sums) == len(changes)


def test_frames_that_are_pinned_are_read_by_their_slots(spec: EnvSpec) -> None:
    table = Table(spec, 8, rng=np.random.default_rng(0))
    table.insert(make_segment(spec, 0, 8))
    drawn = table.sample_pinned(5)
    batch, pinned = drawn.read(), drawn.frames
    np.testing.assert_array_equal(batch.frames[batch.obs_index[:, 0], 0], batch.ids)
    stored = table.stored(pinned.slots)
    np.testing.assert_array_equal(stored.read(), pinned.read(), strict=True)
    assert (len(stored), stored.shape, stored.dtype, stored.nbytes) == (
        len(pinned), pinned.shape, pinned.dtype, pinned.read().nbytes,
    )  # fmt: skip
