"""Stores each frame once, however many transitions stack it, in reference-counted slots of growing memory."""

from __future__ import annotations

import math
from contextlib import suppress
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop.common.process.memory import GrowingRows
from coop.common.process.shared_memory import SharedMemory
from coop.common.types import Array

Slots = NDArray[np.intp]

FIRST_SLOTS = 1024
GROWTH = 1.5


class FrameStore:
    """Slots of one frame each; a slot becomes free when its last reference is dropped.

    Freed slots are used first, then unused ones in ascending order, in one mapping that is enlarged in place: memory
    is committed page by page as frames are written, so it follows the largest number of frames held at once. Not
    thread-safe: one owner makes all calls, including those of `PinnedFrames`.

    Args:
        shared_memory: map memory that other processes of this machine can read, if the system has it.

    Attributes:
        shared_memory: its address, see `SharedMemory`; empty if it is private.
        used: slots ever used; those above were never written. stored: frames ever stored.
        references, numbers_of: of each slot, its references, and the number of its frame, see `numbers`.
        free, free_count: a stack of free slots below `used`, and its height.
        marks: of each slot, scratch memory for finding equal ones.
    """

    def __init__(self, frame_shape: tuple[int, ...], frame_dtype: str, *, shared_memory: bool = False) -> None:
        self.frame_shape = frame_shape
        self.dtype = np.dtype(frame_dtype)
        self.frame_bytes = math.prod(frame_shape) * self.dtype.itemsize
        self.used = self.free_count = self.stored = 0
        self.numbers_of = np.zeros(FIRST_SLOTS, np.int64)
        self.references = np.zeros(FIRST_SLOTS, np.int32)
        self.free = np.zeros(FIRST_SLOTS, np.int32)
        self.marks = np.zeros(FIRST_SLOTS, np.int32)
        self.shared_memory, memory = "", None
        if shared_memory:
            with suppress(OSError):
                # Closes its file when it is collected.
                self._shared = SharedMemory(FIRST_SLOTS * self.frame_bytes)
                memory, self.shared_memory = self._shared.mapped, self._shared.address
        self._rows = GrowingRows(self.frame_bytes, FIRST_SLOTS, memory)

    @property
    def held(self) -> int:
        """Frames with at least one reference."""
        return self.used - self.free_count

    @property
    def bytes_held(self) -> int:
        """Bytes of the held frames, and of the three counters and the frame's number of every slot ever used."""
        return self.held * self.frame_bytes + self.used * (3 * self.references.itemsize + self.numbers_of.itemsize)

    def add(self, frames: Array, references: NDArray[np.intp]) -> Slots:
        """Store frames [n, *frame_shape] with references intp [n] (>= 1) each; return their slots, intp [n]."""
        count = len(frames)
        recycled = min(count, self.free_count)
        fresh = count - recycled
        self.reserve(fresh)
        slots = np.empty(count, np.intp)
        self.free_count -= recycled
        slots[:recycled] = self.free[self.free_count : self.free_count + recycled]
        if fresh:
            slots[recycled:] = np.arange(self.used, self.used + fresh)
            self.used += fresh
        self.write(slots, frames)
        self.references[slots] = references
        self.numbers_of[slots] = np.arange(self.stored + 1, self.stored + count + 1)
        self.stored += count
        return slots

    def reserve(self, fresh: int) -> None:
        """Make room for so many slots more than have ever been used."""
        if self.used + fresh > len(self.references):
            self._grow(self.used + fresh)

    def write(self, slots: Slots, frames: Array) -> None:
        """Copy frames [n, *frame_shape] to slots."""
        self._rows.view[slots] = self._items(frames)

    def numbers(self, slots: Slots) -> NDArray[np.int64]:
        """The numbers, from 1, of the frames in `slots`, int64 [n]: each frame that is stored gets the next one."""
        return self.numbers_of[slots]

    def hold(self, slots: Slots, references: NDArray[np.intp] | int = 1) -> None:
        """Add references to distinct slots that are already held."""
        self.references[slots] += references

    def drop(self, slots: Slots) -> None:
        """Remove one reference for each occurrence of a slot; slots without references become free."""
        np.subtract.at(self.references, slots, np.int32(1))  # a Python 1 would be an int64, and take six times as long
        gone = slots[self.references[slots] == 0]
        if len(gone):
            if len(gone) > 1:
                gone, _ = self._distinct(gone)
            self.free[self.free_count : self.free_count + len(gone)] = gone
            self.free_count += len(gone)

    def unique(self, slots: Slots) -> tuple[Slots, NDArray[np.int32]]:
        """The distinct slots among `slots`, and the index of each slot among them, in the shape of `slots`.

        The order depends only on which slots are equal, not on their numbers. Marks in a scratch array take a fifth of
        the time of sorting.
        """
        flat = slots.reshape(-1)
        distinct, order = self._distinct(flat)
        self.marks[distinct] = order[: len(distinct)]
        return distinct, self.marks[flat].reshape(slots.shape)

    def read(self, slots: Slots, out: Array | None = None) -> Array:
        """Copy the frames in `slots`, [n, *frame_shape], to `out`, contiguous memory, or to a new array."""
        if out is None:
            return self._rows.view.take(slots).view(self.dtype).reshape(len(slots), *self.frame_shape)
        self._rows.view.take(
            slots, out=self._items(out), mode="clip"
        )  # mode: without it numpy first copies to a buffer
        return out

    def pin(self, slots: Slots) -> PinnedFrames:
        """Keep the frames of distinct slots unchanged, to be copied later."""
        return PinnedFrames(self, slots)

    def _distinct(self, slots: Slots) -> tuple[Slots, NDArray[np.int32]]:
        """The distinct slots among slots intp [n], and the numbers 0..n-1."""
        order = np.arange(len(slots), dtype=np.int32)
        self.marks[slots] = order  # the last of equal slots wins
        return slots[self.marks[slots] == order], order

    def _items(self, frames: Array) -> NDArray[np.void]:
        """Frames [n, *frame_shape] as void [n], without a copy if they are contiguous."""
        return np.ascontiguousarray(frames).reshape(-1).view(self._rows.dtype)

    def _grow(self, needed: int) -> None:
        slots = max(needed, int(len(self.references) * GROWTH))
        for name in ("references", "free", "marks", "numbers_of"):
            array = getattr(self, name)
            larger = np.zeros(slots, array.dtype)  # zeros are committed only when written
            larger[: self.used] = array[: self.used]
            setattr(self, name, larger)
        self._rows.grow(slots)


class StoredFrames:
    """Frames of a store as a `wire.Source`; they must be held by others as long as it is used."""

    def __init__(self, store: FrameStore, slots: Slots) -> None:
        self._store = store
        self._slots = slots

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def slots(self) -> Slots:
        """Where the frames lie: intp [n]."""
        return self._slots

    @property
    def numbers(self) -> NDArray[np.int64]:
        """The frames' numbers, int64 [n], see `FrameStore.numbers`."""
        return self._store.numbers(self._slots)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the frames' elements."""
        return self._store.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """(n, *frame_shape)."""
        return len(self._slots), *self._store.frame_shape

    @property
    def nbytes(self) -> int:
        """Of all these frames."""
        return len(self._slots) * self._store.frame_bytes

    def copy_to(self, out: Array) -> None:
        """Copy all these frames to `out`, contiguous memory [n, *frame_shape]."""
        self._store.read(self._slots, out)

    def read(self, start: int = 0, stop: int | None = None) -> Array:
        """Copy of the frames start..stop (default: all): [stop - start, *frame_shape]."""
        return self._store.read(self._slots[start:stop])


class PinnedFrames(StoredFrames):
    """Frames of a store that stay unchanged until `release`, whatever is evicted meanwhile."""

    def __init__(self, store: FrameStore, slots: Slots) -> None:
        super().__init__(store, slots)
        store.hold(slots)

    def release(self) -> None:
        """Release the frames; a second call does nothing."""
        slots, self._slots = self._slots, self._slots[:0]
        self._store.drop(slots)

    def __enter__(self) -> PinnedFrames:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def as_slice(indices: Slots) -> slice | Slots:
    """Convert ascending indices without gaps to a slice, so that frames are copied once and not twice."""
    if len(indices) and indices[-1] - indices[0] + 1 == len(indices):
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices
