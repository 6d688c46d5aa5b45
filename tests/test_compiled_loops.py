"""A table's compiled loops do what numpy does: slots, rows, counts and batches are equal after each call."""

import sys
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from table_reference import Stream, check_references, make_spec

from coop.common.transitions import Segment
from coop.replay.table import streams, table
from coop.replay.table.frames import FIRST_SLOTS
from coop.replay.table.loops import PLAIN, Loops, compiled_loops
from coop.replay.table.table import Table

pytest.importorskip("numba")
COMPILED = compiled_loops()


def state(one: Table) -> dict[str, Any]:
    frames, columns = one._frames, one._columns
    return {
        "free": frames.free[: frames.free_count], "references": frames.references[: frames.used],
        "numbers": frames.numbers_of[: frames.used], "counts": [frames.stored, columns.terminal, len(one)],
        "evicted": one._reuse_evicted, "slots": columns.slots, "tails": one._tails.slots(),
        "streams": one._tails.streams(), **columns.named,
    }  # fmt: skip


def both(monkeypatch: pytest.MonkeyPatch, stack: int, eviction: str, sampling: str, capacity: int) -> list[Table]:
    monkeypatch.setattr(table, "WORTH_COMPILING", 1)
    made = []
    for loops in (PLAIN, COMPILED):
        monkeypatch.setattr(table, "compiled_loops", lambda loops=loops: loops)
        spec = make_spec(stack, "uint8")
        made.append(Table(spec, capacity, eviction=eviction, sampling=sampling, rng=np.random.default_rng(0)))
        made[-1].insert(Stream(spec, 99, np.random.default_rng(0), 20).segment(1))
    return made


@pytest.mark.parametrize("stack", [1, 4])
@pytest.mark.parametrize(
    ("eviction", "sampling"),
    [("fifo", "uniform"), ("fifo", "prioritized"), ("reservoir", "uniform"), ("prioritized", "prioritized")],
)
@pytest.mark.parametrize("most", [2, streams.MAX_STREAMS])
def test_the_loops_do_what_numpy_does(
    most: int, eviction: str, sampling: str, stack: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams, "MAX_STREAMS", most)
    tables = both(monkeypatch, stack, eviction, sampling, 60)
    assert [one._loops for one in tables] == [PLAIN, COMPILED]
    assert {loop.__module__ for loop in COMPILED} == {"coop.replay.table.compiled_loops"}
    spec, rng = make_spec(stack, "uint8"), np.random.default_rng(1)
    players = [Stream(spec, number, np.random.default_rng(number), 9) for number in range(4)]
    lengths = [*(int(rng.integers(1, 12)) for _ in range(120)), 90, 3, 61]
    for turn, length in enumerate(lengths):
        segment = players[int(rng.integers(4))].segment(length)
        if turn % 10 == 9:
            continue  # lost: the next one of this stream repeats frames that the table does not have
        if turn % 3 == 0:
            segment = read_only(segment)
        batches = []
        for one in tables:
            one.insert(segment)
            batch = one.sample(16)
            if sampling == "prioritized":
                ids = np.concatenate((batch.ids, batch.ids - 60, [10**6]))  # of which some are not held
                one.update_priorities(ids, np.abs(np.sin(ids)))
            check_references(one)
            batches.append(batch)
        for name, value in batches[0].columns().items():
            np.testing.assert_array_equal(getattr(batches[1], name), value, err_msg=f"{name} after {turn}")
            assert getattr(batches[1], name).dtype == value.dtype
        np.testing.assert_array_equal(batches[0].frames, batches[1].frames)
        expected, found = map(state, tables)
        for name, value in expected.items():
            np.testing.assert_array_equal(found[name], value, err_msg=f"{name} after {turn}")
    one, other = (one.sample(500) for one in tables)
    np.testing.assert_array_equal(one.frames, other.frames)
    assert tables[0]._columns.terminal > 0
    assert tables[0]._reuse_evicted[4:].any()


def read_only(segment: Segment) -> Segment:
    """With arrays as they come from the wire."""
    arrays = {name: getattr(segment, name).copy() for name in ("frames", "obs_index", "next_index", "terminated")}
    for array in arrays.values():
        array.flags.writeable = False
    return replace(segment, **arrays)


def test_slots_are_there_before_the_loop_writes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = both(monkeypatch, 1, "fifo", "uniform", 3000)
    stream = Stream(make_spec(1, "uint8"), 0, np.random.default_rng(0), 10**6)
    for _ in range(40):
        segment = stream.segment(70)
        for one in tables:
            one.insert(segment)
            assert one._frames.used < len(one._frames.references)
    assert tables[1]._frames.used > FIRST_SLOTS
    np.testing.assert_array_equal(tables[0].sample(3000).frames, tables[1].sample(3000).frames)


def test_frames_that_nobody_needs_are_not_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = both(monkeypatch, 2, "fifo", "uniform", 3)
    segment = Stream(make_spec(2, "uint8"), 0, np.random.default_rng(3), 10**6).segment(40)
    for one in tables:
        one.insert(segment)
        assert one._frames.held == 3 + 2 + 2, "of the last transitions, and of both streams' tails"
    np.testing.assert_array_equal(tables[0]._frames.free, tables[1]._frames.free)


def test_a_table_compiles_when_it_pays_and_numba_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "WORTH_COMPILING", 3)
    spec = make_spec(1)
    one, stream = Table(spec, 5, rng=np.random.default_rng(0)), Stream(spec, 0, np.random.default_rng(0), 50)
    found = []
    for _ in range(4):
        one.insert(stream.segment(2))
        found.append(one._loops)
    assert found == [PLAIN, PLAIN, COMPILED, COMPILED]
    monkeypatch.setitem(sys.modules, "coop.replay.table.compiled_loops", None)
    assert compiled_loops() is PLAIN


@pytest.mark.parametrize("loops", [PLAIN, COMPILED], ids=["numpy", "compiled"])
def test_the_largest_priority(loops: Loops) -> None:
    assert loops.largest(np.array([0.5, 2.0, 1.0])) == 2.0
    assert loops.largest(np.empty(0)) == 0.0
    for wrong in (-1e-9, np.nan, np.inf):
        assert np.isnan(loops.largest(np.array([0.5, wrong, 1.0])))
