"""The table against a list of copies, through random episodes, segment cuts, losses and policies."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from table_reference import Copies, Stream, check_references, held_ids, make_spec, table_stats, whole_state

from coop.common.settings.policies import EVICTIONS, SAMPLERS
from coop.common.transitions import Batch
from coop.replay.table.table import Table


def assert_same(one: Batch, other: Batch) -> None:
    for name in ("frames", *one.columns()):
        a, b = getattr(one, name), getattr(other, name)
        assert a.dtype == b.dtype, name
        np.testing.assert_array_equal(a, b, err_msg=name)


cases = st.fixed_dictionaries(
    {
        "capacity": st.integers(1, 40),
        "stack": st.integers(1, 4),
        "dtype": st.sampled_from(["uint8", "float32"]),
        "eviction": st.sampled_from(EVICTIONS.names()),
        "sampling": st.sampled_from(SAMPLERS.names()),
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


@settings(max_examples=2 * settings.default.max_examples)
@given(case=cases, steps=events)
def test_equals_a_list_of_copies(case: dict[str, Any], steps: list[tuple[str, int]]) -> None:
    for table, copies, _ in play(case, steps):
        assert len(table) == min(copies.inserted, case["capacity"])
        assert held_ids(table) == sorted(copies.held)
        check_references(table)
        stats = table_stats(table)
        assert stats.evicted_unsampled == copies.evicted_unsampled
        assert stats.evicted == stats.inserted - stats.size == sum(stats.reuse_evicted)
        assert sum(stats.reuse_held) == stats.size
        assert table.terminal == sum(bool(terminated) for *_, terminated, _ in copies.held.values())


@settings(max_examples=settings.default.max_examples // 2)
@given(case=cases, steps=events, tail=events)
def test_restored_table_continues_to_the_bit(
    case: dict[str, Any], steps: list[tuple[str, int]], tail: list[tuple[str, int]]
) -> None:
    *_, (table, _, streams) = play(case, steps)
    meta, arrays = whole_state(table)
    meta = msgpack.unpackb(msgpack.packb(meta))
    arrays = {name: array.copy() for name, array in arrays.items()}
    spec = make_spec(case["stack"], case["dtype"])
    twin = Table(
        spec, case["capacity"], eviction=case["eviction"], sampling=case["sampling"], rng=np.random.default_rng(2)
    )
    twin.load_state(meta, arrays)
    check_references(twin)
    # Only the restored one has no trace of frames that are gone.
    assert replace(table_stats(twin), bytes_held=0) == replace(table_stats(table), bytes_held=0)
    rng = np.random.default_rng(3)
    for event, count in tail:
        if event == "insert":
            segment = streams[int(rng.integers(len(streams)))].segment(count)
            table.insert(segment)
            twin.insert(segment)
            assert table_stats(twin).frames_held == table_stats(table).frames_held
        elif len(table):
            batch = table.sample(count)
            assert_same(batch, twin.sample(count))
            for one in (table, twin):
                one.update_priorities(batch.ids, batch.rewards)
        assert held_ids(table) == held_ids(twin)
        assert table.terminal == twin.terminal
    check_references(twin)


@settings(max_examples=settings.default.max_examples // 2)
@given(case=cases, steps=events, tail=events)
def test_pinned_batch_stays_while_the_table_goes_on(
    case: dict[str, Any], steps: list[tuple[str, int]], tail: list[tuple[str, int]]
) -> None:
    *_, (table, _, streams) = play(case, steps)
    assume(len(table))
    pinned = table.sample_pinned(8)
    expected = pinned.read()
    moved = table.pin(expected)
    for event, count in tail:
        if event == "sample":
            table.sample(count)
        else:
            table.insert(streams[0].segment(count))
    for batch in (pinned, moved):
        assert_same(batch.read(), expected)
        out = np.empty(batch.frames.shape, batch.frames.dtype)
        batch.frames.copy_to(out)
        np.testing.assert_array_equal(out, expected.frames)
    check_references(table, np.concatenate([pinned.frames._slots, moved.frames._slots]))
    for batch in (pinned, moved):
        batch.frames.release()
    check_references(table)


@settings(max_examples=settings.default.max_examples // 2)
@given(case=cases, steps=events, tail=events)
def test_snapshot_stays_while_the_table_goes_on(
    case: dict[str, Any], steps: list[tuple[str, int]], tail: list[tuple[str, int]]
) -> None:
    *_, (table, _, streams) = play(case, steps)
    _, then = whole_state(table)
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
