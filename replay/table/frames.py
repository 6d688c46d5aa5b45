"""Frames held once each, however many transitions stack them: reference-counted slots in memory that grows."""

from __future__ import annotations

import mmap
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.types import Array

Slots = NDArray[np.intp]

FIRST_SLOTS = 1024
GROWTH = 1.5


class FrameStore:
    """Slots of one frame each; a slot is free again when its last reference is dropped.

    Slots are used from the lowest up and freed ones are used first, in one private mapping that is enlarged in
    place: memory is committed page by page as frames are written, so it follows the most frames ever held at
    once. Not safe for threads: one owner makes all calls, those of `PinnedFrames` included.
    """

    def __init__(self, frame_shape: tuple[int, ...], frame_dtype: str) -> None:
        self.frame_shape = frame_shape
        self.dtype = np.dtype(frame_dtype)
        self._elements = int(np.prod(frame_shape))
        self.frame_bytes = self._elements * self.dtype.itemsize
        self._used = 0  # slots ever used; those from here up were never written
        self._free_count = 0
        self._references = np.zeros(FIRST_SLOTS, np.int32)
        self._free = np.zeros(FIRST_SLOTS, np.int32)  # a stack of free slots below `_used`
        self._mark = np.zeros(FIRST_SLOTS, np.int32)  # scratch of `unique`
        self._memory = mmap.mmap(-1, FIRST_SLOTS * self.frame_bytes, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        self._rows = self._view(FIRST_SLOTS)

    @property
    def held(self) -> int:
        """Frames with at least one reference."""
        return self._used - self._free_count

    @property
    def references(self) -> NDArray[np.int32]:
        """References of each slot ever used: int32 [slots], a copy."""
        return self._references[: self._used].copy()

    @property
    def bytes_held(self) -> int:
        """Bytes of the held frames and of the three counters kept for every slot ever used."""
        return self.held * self.frame_bytes + self._used * 3 * self._references.itemsize

    def add(self, frames: Array, references: NDArray[np.intp]) -> Slots:
        """Store frames [n, *frame_shape], each with so many references (>= 1); give their slots, intp [n]."""
        count = len(frames)
        recycled = min(count, self._free_count)
        fresh = count - recycled
        if self._used + fresh > len(self._references):
            self._grow(self._used + fresh)
        slots = np.empty(count, np.intp)
        self._free_count -= recycled
        slots[:recycled] = self._free[self._free_count : self._free_count + recycled]
        if fresh:
            slots[recycled:] = np.arange(self._used, self._used + fresh)
            self._used += fresh
        self._rows[slots] = frames.reshape(count, self._elements)
        self._references[slots] = references
        return slots

    def hold(self, slots: Slots, references: NDArray[np.intp] | int = 1) -> None:
        """Add references to slots that are held already and that do not repeat."""
        self._references[slots] += np.asarray(references, np.int32)

    def drop(self, slots: Slots) -> None:
        """Take one reference away for every time a slot is named; slots that nobody refers to become free."""
        np.subtract.at(self._references, slots, np.int32(1))
        gone = slots[self._references[slots] == 0]
        if len(gone):
            if len(gone) > 1:
                gone = self._distinct(gone)
            self._free[self._free_count : self._free_count + len(gone)] = gone
            self._free_count += len(gone)

    def unique(self, slots: Slots) -> tuple[Slots, NDArray[np.int32]]:
        """Distinct slots among `slots`, and for each of `slots` its place among them, in the same shape.

        The order depends only on which slots are equal, never on their numbers. Marks in a scratch array take a
        fifth of the time of sorting.
        """
        flat = slots.reshape(-1)
        distinct = self._distinct(flat)
        self._mark[distinct] = np.arange(len(distinct), dtype=np.int32)
        return distinct, self._mark[flat].reshape(slots.shape)

    def read(self, slots: Slots, out: Array | None = None) -> Array:
        """Copy of the frames in `slots`: [n, *frame_shape]; in `out`, contiguous memory, if it is given."""
        if out is None:
            return self._rows.take(slots, axis=0).reshape(len(slots), *self.frame_shape)
        # mode: without it numpy copies to memory of its own first
        self._rows.take(slots, axis=0, out=out.reshape(len(slots), self._elements), mode="clip")
        return out

    def pin(self, slots: Slots) -> PinnedFrames:
        """Hold distinct slots as they are now, to be copied out later."""
        return PinnedFrames(self, slots)

    def _distinct(self, slots: Slots) -> Slots:
        order = np.arange(len(slots), dtype=np.int32)
        self._mark[slots] = order  # the last of equal slots wins
        distinct: Slots = slots[self._mark[slots] == order]
        return distinct

    def _view(self, slots: int) -> Array:
        return np.frombuffer(self._memory, self.dtype, slots * self._elements).reshape(slots, self._elements)

    def _grow(self, needed: int) -> None:
        slots = max(needed, int(len(self._references) * GROWTH))
        for name in ("_references", "_free", "_mark"):
            larger = np.zeros(slots, np.int32)  # zeros are committed only when written
            larger[: self._used] = getattr(self, name)[: self._used]
            setattr(self, name, larger)
        del self._rows  # a mapping with a view on it can't be moved
        self._memory.resize(slots * self.frame_bytes)
        self._rows = self._view(slots)


class PinnedFrames:
    """Frames of a store that stay as they are until `release`, whatever is evicted meanwhile; a `wire.Source`."""

    def __init__(self, store: FrameStore, slots: Slots) -> None:
        self._store = store
        self._slots = slots
        store.hold(slots)

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of a frame's elements."""
        return self._store.dtype

    @property
    def shape(self) -> tuple[int, ...]:
        """(n, *frame_shape)."""
        return len(self._slots), *self._store.frame_shape

    @property
    def nbytes(self) -> int:
        """Of all of them."""
        return len(self._slots) * self._store.frame_bytes

    def copy_to(self, out: Array) -> None:
        """Copy them all to `out`, contiguous memory [n, *frame_shape]."""
        self._store.read(self._slots, out)

    def read(self, start: int = 0, stop: int | None = None) -> Array:
        """Copy of the pinned frames start..stop, all if not given: [stop - start, *frame_shape]."""
        return self._store.read(self._slots[start:stop])

    def release(self) -> None:
        """Give the frames back; a second call changes nothing."""
        slots, self._slots = self._slots, self._slots[:0]
        self._store.drop(slots)

    def __enter__(self) -> PinnedFrames:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def as_slice(indices: Slots) -> slice | Slots:
    """Ascending indices as a slice where they have no gap, so that frames are copied once and not twice."""
    if len(indices) and indices[-1] - indices[0] + 1 == len(indices):
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices
