"""Which segments have been seen: retries are recognised, reordered ones are not taken for retries."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Any

from common.bounds import MAX_GAPS, MAX_INTEGER, MAX_STREAMS


@dataclass(slots=True)
class _Stream:
    """Everything up to `highest` was seen, the numbers in `gaps` (in ascending order) excepted."""

    highest: int = -1
    gaps: dict[int, None] = field(default_factory=dict)


class SeenWindow:
    """Sequence numbers seen of every (incarnation, stream), counted from 0.

    A stream remembers its newest `max_gaps` missing numbers, and the `max_streams` streams that were used last do so;
    of the others their names alone are left. What is forgotten counts as lost, and whatever comes after it was
    forgotten is refused, all of a stream whose name is left: never twice goes before at least once.
    """

    def __init__(self, max_streams: int = MAX_STREAMS, max_gaps: int = MAX_GAPS) -> None:
        self._max_streams = max_streams
        self._max_gaps = max_gaps
        self._streams: OrderedDict[tuple[int, int], _Stream] = OrderedDict()
        self._closed: set[tuple[int, int]] = set()  # streams of which the name is left
        self._forgotten = 0

    def seen(self, incarnation: int, stream: int, sequence: int) -> bool:
        """True where `accept` would refuse; records nothing."""
        if (incarnation, stream) in self._closed:
            return True
        seen = self._streams.get((incarnation, stream))
        return seen is not None and sequence <= seen.highest and sequence not in seen.gaps

    def accept(self, incarnation: int, stream: int, sequence: int) -> bool:
        """Record a sequence number (>= 0); False where it was seen before."""
        if (incarnation, stream) in self._closed:
            return False
        seen = self._streams.setdefault((incarnation, stream), _Stream())
        self._streams.move_to_end((incarnation, stream))
        if len(self._streams) > self._max_streams:
            name, oldest = self._streams.popitem(last=False)
            self._closed.add(name)
            self._forgotten += len(oldest.gaps)
        if sequence > seen.highest:
            self._open_gaps(seen, sequence)
            seen.highest = sequence
            return True
        if sequence in seen.gaps:
            del seen.gaps[sequence]
            return True
        return False

    def missing(self) -> int:
        """Numbers skipped below the highest seen of their stream: lost, unless they still come."""
        return self._forgotten + sum(len(seen.gaps) for seen in self._streams.values())

    def state(self) -> dict[str, Any]:
        """Everything seen, msgpack-able, streams in order of last use."""
        return {
            "forgotten": min(self._forgotten, MAX_INTEGER),
            "closed": sorted(self._closed),
            "streams": [[*key, seen.highest, list(seen.gaps)] for key, seen in self._streams.items()],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue where `state` was taken."""
        self._forgotten = state["forgotten"]
        self._closed = {(incarnation, stream) for incarnation, stream in state.get("closed", [])}
        self._streams = OrderedDict(
            ((incarnation, stream), _Stream(highest, dict.fromkeys(gaps)))
            for incarnation, stream, highest, gaps in state["streams"]
        )

    def _open_gaps(self, seen: _Stream, sequence: int) -> None:
        start = max(seen.highest + 1, sequence - self._max_gaps)
        self._forgotten += start - (seen.highest + 1)
        seen.gaps.update(dict.fromkeys(range(start, sequence)))
        while len(seen.gaps) > self._max_gaps:
            del seen.gaps[next(iter(seen.gaps))]
            self._forgotten += 1
