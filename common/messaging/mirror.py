"""The learner's mirror of the table's frames: each frame crosses the network once, whatever is lost or repeated.

The table keeps each frame in a slot and gives it a number that no other frame of this table ever gets. An answer to a
draw names slots and numbers of its batch's frames, and carries those frames that the mirror lacks as far as the replay
service knows (`coop.replay.mirrored`). The learner compares the numbers before it reads a slot, so it can't read a
wrong frame; where it lacks one, it asks again, and a draw that is answered again carries all its frames.

Nothing here does I/O. `coop.learner.device_mirror` keeps the frames on a GPU.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from coop.common.messaging.messages.sample import NamedBatch
from coop.common.process.memory import GrowingRows
from coop.common.transitions import Batch
from coop.common.types import Array, EnvSpec

FIRST_SLOTS = 1024
GROWTH = 1.5


class FrameMirror:
    """Copies of the frames that batches have needed, in the slots that they have in the table, in host memory.

    Args:
        slots: at most so many; frames in higher slots are in each answer.

    Attributes:
        slots: as given, or fewer where memory ran out.
        number: counts the times that the mirror began, empty: once, and again for each table that it met.
    """

    def __init__(self, spec: EnvSpec, slots: int) -> None:
        self.number = 1
        self.slots = slots
        self._shape = spec.frame_shape
        self._dtype = np.dtype(spec.frame_dtype)
        self._table: int | None = None
        self._numbers = np.zeros(self._allocate(slots), np.int64)  # of the frame in each slot; 0: none

    def _allocate(self, slots: int) -> int:
        """Make the rows of the first slots; returns how many."""
        first = min(slots, FIRST_SLOTS)
        self._rows = GrowingRows(math.prod(self._shape) * self._dtype.itemsize, max(1, first))
        return first

    def write(self, table: int, slots: NDArray[np.int32], numbers: NDArray[np.int64], frames: Array) -> None:
        """Store frames [n, *frame_shape] of a table, with these numbers, int64 [n], in these slots, int32 [n].

        A table other than the last one empties the mirror first.
        """
        if table != self._table:
            self.number += self._table is not None
            self._table = table
            self._numbers.fill(0)
        if not len(slots):
            return
        highest = slots.item(slots.argmax())
        if self.slots > len(self._numbers) <= highest:
            self._grow(highest + 1)
        if highest >= self.slots:
            inside = slots < self.slots
            slots, numbers, frames = slots[inside], numbers[inside], frames[inside]
        self._write(slots, frames)
        self._numbers[slots] = numbers

    def read(self, batch: NamedBatch) -> Batch | None:
        """The batch with its frames; None if one of them is neither here nor in its answer."""
        held = self._numbers.take(batch.slots, mode="clip") == batch.numbers
        held &= batch.slots < len(self._numbers)
        here = bool(held.all())
        held[batch.carried] = True
        return self._read(batch, here) if batch.table == self._table and held.all() else None

    def _write(self, slots: NDArray[np.int32], frames: Array) -> None:
        """Store frames in slots that have rows."""
        self._rows.view[slots] = self._items(frames)

    def _read(self, batch: NamedBatch, here: bool) -> Batch:
        """The batch with its frames; those that its answer does not carry are here, and if `here` these too."""
        found = np.empty(len(batch.slots), self._rows.dtype)
        self._rows.view.take(batch.slots, out=found, mode="clip")
        if not here:
            found[batch.carried] = self._items(batch.frames)
        return Batch(frames=found.view(self._dtype).reshape(len(found), *self._shape), **batch.columns)

    def _items(self, frames: Array) -> NDArray[np.void]:
        """Frames [n, *frame_shape] as void [n]."""
        return np.ascontiguousarray(frames).reshape(-1).view(self._rows.dtype)

    def _grow(self, needed: int) -> None:
        """Make room up to slot number `needed`, or remain as large as it is for good if there is none."""
        slots = min(self.slots, max(needed, int(len(self._numbers) * GROWTH)))
        try:
            self._rows.grow(slots)
        except OSError:
            self.slots = len(self._numbers)
            return
        numbers = np.zeros(slots, np.int64)
        numbers[: len(self._numbers)] = self._numbers
        self._numbers = numbers
