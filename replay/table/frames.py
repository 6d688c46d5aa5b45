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
    """

    def __init__(self, frame_shape: tuple[int, ...], frame_dtype: str, *, shared_memory: bool = False) -> None:
        self.frame_shape = frame_shape
        self.dtype = np.dtype(frame_dtype)
        self.frame_bytes = math.prod(frame_shape) * self.dtype.itemsize
        self._used = 0  # slots ever used; those above were never written
        self._free_count = 0
        self._stored = 0  # frames ever stored
        self._numbers = np.zeros(FIRST_SLOTS, np.int64)  # of the frame in each slot, in the order in which they came
        self._references = np.zeros(FIRST_SLOTS, np.int32)
        self._free = np.zeros(FIRST_SLOTS, np.int32)  # a stack of free slots below `_used`
        self._mark = np.zeros(FIRST_SLOTS, np.int32)  # scratch of `unique`
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
        return self._used - self._free_count

    @property
    def references(self) -> NDArray[np.int32]:
        """References of each slot ever used: int32 [slots], a copy."""
        return self._references[: self._used].copy()

    @property
    def bytes_held(self) -> int:
        """Bytes of the held frames, and of the three counters and the frame's number of every slot ever used."""
        return self.held * self.frame_bytes + self._used * (3 * self._references.itemsize + self._numbers.itemsize)

    def add(self, frames: Array, references: NDArray[np.intp]) -> Slots:
        """Store frames [n, *frame_shape] with references intp [n] (>= 1) each; return their slots, intp [n]."""
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
        self._rows.view[slots] = self._items(frames)
        self._references[slots] = references
        self._numbers[slots] = np.arange(self._stored + 1, self._stored + count + 1)
        self._stored += count
        return slots

    def numbers(self, slots: Slots) -> NDArray[np.int64]:
        """The numbers, from 1, of the frames in `slots`, int64 [n]: each frame that is stored gets the next one."""
        return self._numbers[slots]

    def hold(self, slots: Slots, references: NDArray[np.intp] | int = 1) -> None:
        """Add references to distinct slots that are already held."""
        self._references[slots] += references

    def drop(self, slots: Slots) -> None:
        """Remove one reference for each occurrence of a slot; slots without references become free."""
        np.subtract.at(self._references, slots, np.int32(1))  # a Python 1 would be an int64, and take six times as long
        gone = slots[self._references[slots] == 0]
        if len(gone):
            if len(gone) > 1:
                gone, _ = self._distinct(gone)
            self._free[self._free_count : self._free_count + len(gone)] = gone
            self._free_count += len(gone)

    def unique(self, slots: Slots) -> tuple[Slots, NDArray[np.int32]]:
        """The distinct slots among `slots`, and the index of each slot among them, in the shape of `slots`.

        The order depends only on which slots are equal, not on their numbers. Marks in a scratch array take a fifth of
        the time of sorting.
        """
        flat = slots.reshape(-1)
        distinct, order = self._distinct(flat)
        self._mark[distinct] = order[: len(distinct)]
        return distinct, self._mark[flat].reshape(slots.shape)

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
        self._mark[slots] = order  # the last of equal slots wins
        return slots[self._mark[slots] == order], order

    def _items(self, frames: Array) -> NDArray[np.void]:
        """Frames [n, *frame_shape] as void [n], without a copy if they are contiguous."""
        return np.ascontiguousarray(frames).reshape(-1).view(self._rows.dtype)

    def _grow(self, needed: int) -> None:
        slots = max(needed, int(len(self._references) * GROWTH))
        for name in ("_references", "_free", "_mark", "_numbers"):
            array = getattr(self, name)
            larger = np.zeros(slots, array.dtype)  # zeros are committed only when written
            larger[: self._used] = array[: self._used]
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
