"""Filters duplicate segments: recognises retries, and does not mistake reordered segments for retries."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

from coop.common.bounds import MAX_GAPS, MAX_INTEGER, MAX_STREAMS

_start = attrgetter("start")


@dataclass(slots=True)
class _Stream:
    """All numbers up to `highest` were seen except those in `gaps`: disjoint, not empty, in ascending order.

    A gap is a range of any length, so the memory that an arrival adds does not depend on how far it jumps.
    """

    highest: int = -1
    gaps: list[range] = field(default_factory=list)

    def gap_of(self, sequence: int) -> int | None:
        """The index of the gap that contains a number; None if it was seen, or is above all others."""
        index = bisect_right(self.gaps, sequence, key=_start) - 1
        return index if index >= 0 and sequence in self.gaps[index] else None


class DuplicateFilter:
    """Sequence numbers seen of every (incarnation, stream), counted from 0.

    The filter remembers the newest `max_gaps` gaps of the `max_streams` streams used last, and only the names of the
    other streams. Numbers in forgotten gaps count as lost, and are refused if they arrive later, as is everything
    of a stream of which only the name is left: at-most-once takes precedence over at-least-once. An accepted number
    adds at most one gap or one name, so memory is bounded by the number of segments.
    """

    def __init__(self, max_streams: int = MAX_STREAMS, max_gaps: int = MAX_GAPS) -> None:
        self._max_streams = max_streams
        self._max_gaps = max_gaps
        self._streams: OrderedDict[tuple[int, int], _Stream] = OrderedDict()
        self._closed: set[tuple[int, int]] = set()  # streams of which only the name is left
        self._missing = 0

    def seen(self, incarnation: int, stream: int, sequence: int) -> bool:
        """Whether `accept` would refuse; records nothing."""
        if (incarnation, stream) in self._closed:
            return True
        seen = self._streams.get((incarnation, stream))
        return seen is not None and sequence <= seen.highest and seen.gap_of(sequence) is None

    def accept(self, incarnation: int, stream: int, sequence: int) -> bool:
        """Record a sequence number (>= 0); return False if it was seen before."""
        if (incarnation, stream) in self._closed:
            return False
        seen = self._streams.setdefault((incarnation, stream), _Stream())
        self._streams.move_to_end((incarnation, stream))
        if len(self._streams) > self._max_streams:
            self._closed.add(self._streams.popitem(last=False)[0])
        if sequence > seen.highest:
            skipped = range(seen.highest + 1, sequence)
            if skipped:
                seen.gaps.append(skipped)
                self._missing += len(skipped)
            seen.highest = sequence
        else:
            index = seen.gap_of(sequence)
            if index is None:
                return False
            gap = seen.gaps[index]
            parts = range(gap.start, sequence), range(sequence + 1, gap.stop)
            seen.gaps[index : index + 1] = [part for part in parts if part]
            self._missing -= 1
        del seen.gaps[: -self._max_gaps]
        return True

    def missing(self) -> int:
        """Count of numbers skipped below the highest of their stream: lost, unless they still arrive."""
        return self._missing

    def state(self) -> dict[str, Any]:
        """The state for `load_state` and msgpack, with streams in order of last use."""
        forgotten = self._missing - sum(_lengths(self._streams.values()))
        return {
            "forgotten": min(forgotten, MAX_INTEGER),
            "closed": sorted(self._closed),
            "streams": [
                [*key, seen.highest, [[gap.start, gap.stop] for gap in seen.gaps]]
                for key, seen in self._streams.items()
            ],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
        self._closed = {(incarnation, stream) for incarnation, stream in state["closed"]}
        self._streams = OrderedDict(
            ((incarnation, stream), _Stream(highest, [range(*gap) for gap in gaps]))
            for incarnation, stream, highest, gaps in state["streams"]
        )
        self._missing = state["forgotten"] + sum(_lengths(self._streams.values()))


def _lengths(streams: Iterable[_Stream]) -> Iterable[int]:
    return (len(gap) for seen in streams for gap in seen.gaps)
