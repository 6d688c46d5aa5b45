"""Numbers of the episodes to which a table's transitions belong, for policies that use them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop.common.transitions import Segment
from coop.common.types import Array
from coop.replay.table.frames import Slots
from coop.replay.table.streams import MAX_STREAMS

EPISODES = "episodes"  # in a table's state


class EpisodeNumbers:
    """Numbers episodes from 0 in order of their first transition.

    of_rows: int64 [capacity], the number of the transition in each row.
    """

    def __init__(self, capacity: int) -> None:
        self.of_rows = np.zeros(capacity, np.int64)
        self._begun = 0
        self._running: dict[tuple[int, int], int] = {}  # of streams; the one that has been silent longest first

    def number(self, segment: Segment) -> NDArray[np.int64]:
        """The number of each transition of a segment that has not been inserted yet, int64 [steps]."""
        stream, start = (segment.incarnation, segment.stream), 0
        current = self._running.pop(stream, None)
        numbers = np.empty(segment.steps, np.int64)
        for stop in (*(end.step_in_segment + 1 for end in segment.episodes), segment.steps):
            if start < stop:
                current = self._begin() if current is None else current
                numbers[start:stop] = current
            if stop < segment.steps or (segment.episodes and stop == segment.episodes[-1].step_in_segment + 1):
                current = None
            start = stop
        if current is not None:
            self._running[stream] = current
        if len(self._running) > MAX_STREAMS:
            del self._running[next(iter(self._running))]
        return numbers

    def write(self, rows: Slots, numbers: NDArray[np.int64]) -> None:
        """Note the numbers of transitions that go to these rows."""
        self.of_rows[rows] = numbers

    def state(self) -> list[Any]:
        """What `load_state` takes, beside the rows."""
        return [self._begun, [[*stream, number] for stream, number in self._running.items()]]

    def load_state(self, state: list[Any], of_rows: Array) -> None:
        """Restore what `state` gave, and the numbers int64 [size] of the first rows."""
        self._begun, running = state
        self._running = {(incarnation, stream): number for incarnation, stream, number in running}
        self.of_rows[: len(of_rows)] = of_rows

    def _begin(self) -> int:
        self._begun += 1
        return self._begun - 1
