"""What a table keeps of each transition, a row each: numbers, and the slots of its frames."""

from __future__ import annotations

import numpy as np

from coop.common.transitions import IN_BATCH, IN_SEGMENT, KEPT, Segment, columns_of
from coop.common.types import Array, EnvSpec
from coop.replay.table.frames import Slots


class Columns:
    """The fields of `capacity` transitions; callers may read the arrays, and write `reuse` and `priorities`.

    named: what `coop.common.transitions` says that a table keeps, and `priorities`: float64, of length 0 unless
        `prioritized`.
    slots: int32 [capacity, 2 * stack], the frames of obs, then of next_obs, as slots of a `FrameStore`.
    ids: int64, the transition's number in order of insertion. reuse: int32, how often it has been drawn.
    terminal: rows whose next state is terminal.
    """

    def __init__(self, capacity: int, spec: EnvSpec, *, prioritized: bool) -> None:
        self.slots = np.zeros((capacity, 2 * spec.stack), np.int32)
        fields = columns_of(KEPT, spec)
        self._written = [name for name in columns_of(IN_SEGMENT, spec) if name in fields]
        self._read = [name for name in columns_of(IN_BATCH, spec) if name in fields]
        self.named: dict[str, Array] = {
            name: np.zeros((capacity, *field.row_shape(spec)), field.dtype) for name, field in fields.items()
        }
        self.ids, self.reuse, self._terminated = (self.named[name] for name in ("ids", "reuse", "terminated"))
        self.priorities = self.named["priorities"] = np.zeros(capacity if prioritized else 0)
        self.terminal = 0

    @property
    def row_bytes(self) -> int:
        """Bytes of memory a transition takes here, without its frames."""
        return (self.slots.nbytes + sum(column.nbytes for column in self.named.values())) // len(self.ids)

    def write(self, rows: Slots, segment: Segment, kept: slice | Slots, first: int, slots: Array) -> None:
        """Put transitions `kept` of a segment, whose first one has the number `first`, into `rows`, never drawn yet."""
        self.terminal -= int(np.count_nonzero(self._terminated[rows]))
        self.slots[rows] = slots
        self.write_given(rows, segment, kept)
        self.terminal += int(np.count_nonzero(segment.terminated[kept]))
        self.ids[rows] = np.arange(first, first + segment.steps)[kept]
        self.reuse[rows] = 0

    def write_given(self, rows: slice | Slots, segment: Segment, kept: slice | Slots) -> None:
        """Write what a segment brings: all but slots, ids and reuse."""
        for name in self._written:
            self.named[name][rows] = getattr(segment, name)[kept]

    def read(self, rows: Slots) -> dict[str, Array]:
        """Copy the fields of `rows` that a batch carries, by name."""
        return {name: self.named[name][rows] for name in self._read}

    def state(self, size: int) -> dict[str, Array]:
        """Copy the first `size` rows of each column, without the slots."""
        return {name: column[:size].copy() for name, column in self.named.items()}

    def load_state(self, arrays: dict[str, Array], slots: Slots) -> None:
        """Restore what `state` gave, with the slots intp [size, 2 * stack] that the frames have now."""
        size = len(slots)
        self.slots[:size] = slots
        for name, column in self.named.items():
            column[:size] = arrays[name]
        self.terminal = int(np.count_nonzero(self._terminated[:size]))
