"""Stores segments' frames, without storing again those that a segment shares with its predecessor."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from coop.common import bounds
from coop.common.transitions import Segment
from coop.replay.table.frames import FrameStore, Slots, as_slice

MAX_STREAMS = 4096
_NONE = np.empty(0, np.intp)
PRELOADED = bounds.MAX_STREAMS - 1  # the stream of the transitions that a table begins with; no emulator's


class StreamTails:
    """The last segment's number and the slots of its last frames of each stream, which the next segment may repeat.

    A tail holds a reference to each of its stored frames; -1 stands for a frame that is not stored. Beyond
    `MAX_STREAMS`, the stream that has been silent longest is forgotten.
    """

    def __init__(self, frames: FrameStore, stack: int) -> None:
        self._frames = frames
        self._stack = stack
        self._tails: OrderedDict[tuple[int, int], tuple[int, Slots]] = OrderedDict()

    def store(self, segment: Segment, index: NDArray[np.int32]) -> tuple[Slots, Slots]:
        """Store those frames of a segment that occur in `index`, each once.

        Returns (slots of all its frames, -1 if not stored; slots to drop once the transitions are in place).
        The stream keeps references to its last frames, as many as the next segment is likely to repeat.
        """
        count = len(segment.frames)
        references = np.bincount(index.reshape(-1), minlength=count)
        slots = np.empty(count, np.intp)
        slots.fill(-1)
        previous, shared = self.take(segment)
        slots[segment.carried - shared : segment.carried] = previous[len(previous) - shared :]
        known = slots >= 0
        wanted = references > 0
        tail = self.begin(segment)
        wanted[tail:] |= known[tail:]
        references[tail:] += wanted[tail:]
        again = (wanted & known).nonzero()[0]
        self._frames.hold(slots[again], references[again])
        new = (wanted > known).nonzero()[0]
        slots[new] = self._frames.add(segment.frames[as_slice(new)], references[new])
        dropped = np.concatenate((previous, self.keep(segment, slots[tail:])))
        return slots, dropped[dropped >= 0]

    def take(self, segment: Segment) -> tuple[Slots, int]:
        """Remove the tail of a segment's stream; returns its slots, and how many of the last the segment repeats."""
        sequence, previous = self._tails.pop((segment.incarnation, segment.stream), (-1, _NONE))
        return previous, min(segment.carried, len(previous)) if sequence == segment.sequence - 1 else 0

    def begin(self, segment: Segment) -> int:
        """The first of a segment's frames that its stream is to keep."""
        return max(0, len(segment.frames) - max(self._stack, segment.carried))

    def keep(self, segment: Segment, slots: Slots) -> Slots:
        """Keep the slots of a segment's last frames; returns those of a stream that is forgotten for them."""
        self._tails[segment.incarnation, segment.stream] = segment.sequence, slots.copy()
        return _NONE if len(self._tails) <= MAX_STREAMS else self._tails.popitem(last=False)[1][1]

    def slots(self) -> Slots:
        """The slots of all tails, stream by stream."""
        return np.concatenate([*(tail for _, tail in self._tails.values()), np.empty(0, np.intp)])

    def streams(self) -> list[list[int]]:
        """Incarnation, stream, number of its last segment and length of its tail, in the order of `slots`."""
        return [[*key, sequence, len(tail)] for key, (sequence, tail) in self._tails.items()]

    def load_state(self, streams: list[list[int]], slots: Slots) -> None:
        """Restore the values of `streams` and `slots`; the caller must add the references."""
        start = 0
        for incarnation, stream, sequence, length in streams:
            self._tails[incarnation, stream] = sequence, slots[start : start + length].copy()
            start += length
