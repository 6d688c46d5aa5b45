"""What a table keeps of each transition, a row each: numbers, and the slots of its frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coop.common.types import Array, Segment
from coop.replay.table.frames import Slots

_NAMES = ("actions", "rewards", "terminated", "span", "param_version", "ids", "reuse", "priorities")


class Columns:
    """The fields of `capacity` transitions; callers may read the arrays, and write `reuse` and `priorities`.

    slots: int32 [capacity, 2 * stack], the frames of obs, then of next_obs, as slots of a `FrameStore`.
    ids: int64, the transition's number in order of insertion. reuse: int32, how often it has been drawn.
    priorities: float64, of length 0 unless `prioritized`. terminal: rows whose next state is terminal.
    """

    def __init__(self, capacity: int, stack: int, *, prioritized: bool) -> None:
        self.slots = np.zeros((capacity, 2 * stack), np.int32)
        self.actions = np.zeros(capacity, np.int32)
        self.rewards = np.zeros(capacity, np.float32)
        self.terminated = np.zeros(capacity, np.bool_)
        self.span = np.ones(capacity, np.uint8)
        self.param_version = np.zeros(capacity, np.int64)
        self.ids = np.zeros(capacity, np.int64)
        self.reuse = np.zeros(capacity, np.int32)
        self.priorities = np.zeros(capacity if prioritized else 0)
        self.terminal = 0

    @property
    def row_bytes(self) -> int:
        """Bytes of memory a transition takes here, without its frames."""
        return (self.slots.nbytes + sum(column.nbytes for column in self._named().values())) // len(self.ids)

    def write(self, rows: Slots, segment: Segment, kept: slice | Slots, first: int, slots: Array) -> None:
        """Put transitions `kept` of a segment, whose first one has the number `first`, into `rows`, never drawn yet."""
        terminated = segment.terminated[kept]
        self.terminal += int(np.count_nonzero(terminated)) - int(np.count_nonzero(self.terminated[rows]))
        self.slots[rows] = slots
        self.actions[rows] = segment.actions[kept]
        self.rewards[rows] = segment.rewards[kept]
        self.terminated[rows] = terminated
        self.span[rows] = segment.span[kept]
        self.param_version[rows] = segment.param_version[kept]
        self.ids[rows] = np.arange(first, first + segment.steps)[kept]
        self.reuse[rows] = 0

    def read(self, rows: Slots) -> dict[str, Array]:
        """Copy the fields of `rows` that a batch carries, by name."""
        names = ("actions", "rewards", "terminated", "span", "ids", "param_version", "reuse")
        return {name: getattr(self, name)[rows] for name in names}

    def state(self, size: int) -> dict[str, Array]:
        """Copy the first `size` rows of each column, without the slots."""
        return {name: column[:size].copy() for name, column in self._named().items()}

    def load_state(self, arrays: dict[str, Array], slots: Slots) -> None:
        """Restore what `state` gave, with the slots intp [size, 2 * stack] that the frames have now."""
        size = len(slots)
        self.slots[:size] = slots
        for name, column in self._named().items():
            column[:size] = arrays[name]
        self.terminal = int(np.count_nonzero(self.terminated[:size]))

    def _named(self) -> dict[str, NDArray[np.generic]]:
        return {name: getattr(self, name) for name in _NAMES}
