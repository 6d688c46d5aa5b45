"""Every sequence number is accepted once, in whatever order and however often it comes."""

from __future__ import annotations

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coop.common.bounds import MAX_COUNT, MAX_GAPS
from coop.replay.dedup import DuplicateFilter

arrivals = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 1), st.integers(0, 30)), max_size=200)


@settings(max_examples=200)
@given(arrivals=arrivals)
def test_equals_a_set(arrivals: list[tuple[int, int, int]]) -> None:
    window, seen = DuplicateFilter(), set()
    for arrival in arrivals:
        assert window.seen(*arrival) == (arrival in seen)
        assert window.accept(*arrival) == (arrival not in seen)
        seen.add(arrival)
    streams = {arrival[:2] for arrival in seen}
    highest = {stream: max(arrival[2] for arrival in seen if arrival[:2] == stream) for stream in streams}
    assert window.missing() == sum(highest.values()) + len(highest) - len(seen)


@settings(max_examples=100)
@given(before=arrivals, after=arrivals)
def test_restored_window_goes_on_alike(before: list[tuple[int, int, int]], after: list[tuple[int, int, int]]) -> None:
    window = DuplicateFilter(max_streams=3, max_gaps=5)
    for arrival in before:
        window.accept(*arrival)
    twin = DuplicateFilter(max_streams=3, max_gaps=5)
    twin.load_state(msgpack.unpackb(msgpack.packb(window.state())))
    for arrival in after:
        known = window.seen(*arrival)
        assert twin.accept(*arrival) == window.accept(*arrival) == (not known)
        assert twin.state() == window.state()


@settings(max_examples=100)
@given(arrivals=arrivals)
def test_what_is_forgotten_is_never_accepted_twice(arrivals: list[tuple[int, int, int]]) -> None:
    window, accepted = DuplicateFilter(max_streams=2, max_gaps=2), []
    for arrival in arrivals:
        if window.accept(*arrival):
            accepted.append(arrival)
        assert window.seen(*arrival)
    assert len(accepted) == len(set(accepted))


def test_large_jumps_take_one_gap_each() -> None:
    """An actor's certificate is enough to skip numbers: what it makes the service hold depends on inserts alone."""
    window, streams, each = DuplicateFilter(), 10, 200
    for sequence in range(MAX_COUNT // each, MAX_COUNT, MAX_COUNT // each)[:each]:
        for stream in range(streams):
            assert window.accept(1, stream, sequence)
    held = [len(gaps) for *_, gaps in window.state()["streams"]]
    assert sum(held) <= streams * each
    for sequence in range(2, 5 * MAX_GAPS, 2):
        assert window.accept(2, 0, sequence)
    assert max(len(gaps) for *_, gaps in window.state()["streams"]) == MAX_GAPS


@pytest.mark.parametrize(
    ("sequences", "accepted", "missing"),
    [
        ([0, 1, 2], [True, True, True], 0),
        ([0, 0, 1, 0], [True, False, True, False], 0),
        ([2, 0], [True, True], 1),
        ([2, 0, 1, 1], [True, True, True, False], 0),
        ([10, 0, 9, 5], [True, True, True, True], 7),  # the ends of a gap, and its middle
        ([1, 3, 5, 7, 9, 0, 2], [True, True, True, True, True, False, True], 4),  # the oldest of five gaps is forgotten
        ([1, 3, 5, 20, 12, 0, 2, 15], [True, True, True, True, True, False, True, True], 14),  # 12 makes five of four
        ([1 << 62, 0, (1 << 62) - 1], [True, True, True], (1 << 62) - 2),
    ],
)
def test_gaps(sequences: list[int], accepted: list[bool], missing: int) -> None:
    window = DuplicateFilter(max_gaps=4)
    assert [window.accept(1 << 63, 0, sequence) for sequence in sequences] == accepted
    assert window.missing() == missing


def test_streams_used_least_recently_are_forgotten() -> None:
    window = DuplicateFilter(max_streams=2)
    assert window.accept(1, 0, 1)  # 0 is missing
    assert window.accept(2, 0, 0)
    assert not window.accept(1, 0, 1)
    assert window.accept(3, 0, 0)  # drops stream 2
    assert not window.accept(1, 0, 1)
    assert window.accept(4, 0, 0)  # drops stream 3
    assert window.accept(5, 0, 0)  # drops stream 1, and its missing 0 is lost
    assert window.missing() == 1
    assert len(window.state()["streams"]) == 2
    twin = DuplicateFilter(max_streams=2)
    twin.load_state(msgpack.unpackb(msgpack.packb(window.state())))
    for one in (window, twin):
        for incarnation, sequence in ((1, 1), (2, 0), (3, 0), (1, 0), (1, 2)):
            assert one.seen(incarnation, 0, sequence)
            assert not one.accept(incarnation, 0, sequence), "a stream that was forgotten is not taken for a new one"
