"""How transitions come into the rows of a table, how batches come out, and whose priorities change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop.common.transitions import Segment
from coop.replay.table.columns import Columns
from coop.replay.table.frames import FrameStore, Slots
from coop.replay.table.streams import StreamTails

REUSE_BUCKETS = 16
_BUCKETS = 2 ** np.arange(REUSE_BUCKETS - 1, dtype=np.int32)  # the fewest draws of each bucket but the first


class Placed(NamedTuple):
    """A segment, and where its transitions go: those at the positions `kept` into `rows`.

    first: number of its first transition of all ever inserted. size: transitions held so far, in the lowest rows.
    """

    segment: Segment
    rows: Slots
    kept: slice | Slots
    first: int
    size: int


class Loops(NamedTuple):
    """The functions of this module, or those that a compiler has made; both give the same bits."""

    put: Callable[[FrameStore, StreamTails, Columns, NDArray[np.int64], Placed], int]
    gather: Callable[[FrameStore, Columns, Slots], tuple[Slots, NDArray[np.int32], NDArray[np.int32]]]
    largest: Callable[[NDArray[np.float64]], float]
    held: Callable[[Columns, int, NDArray[Any], Slots, NDArray[np.float64]], tuple[Slots, NDArray[np.float64]]]


def put(
    frames: FrameStore, tails: StreamTails, columns: Columns, reuse_evicted: NDArray[np.int64], placed: Placed
) -> int:
    """Store the frames, write the rows, and drop what was there; returns by how many transitions the table grows.

    reuse_evicted: counted up, see `reuse_histogram`.
    """
    segment, rows, kept, first, size = placed
    index = np.concatenate((segment.obs_index[kept], segment.next_index[kept]), axis=1)
    slots, dropped = tails.store(segment, index)
    replaced = rows[rows < size]
    reuse_evicted += reuse_histogram(columns.reuse[replaced])
    old = columns.slots.take(replaced, axis=0).ravel()
    columns.write(rows, segment, kept, first, slots[index])
    frames.drop(np.concatenate((old, dropped)))
    return len(rows) - len(replaced)


def gather(frames: FrameStore, columns: Columns, rows: Slots) -> tuple[Slots, NDArray[np.int32], NDArray[np.int32]]:
    """Count a draw of each row; returns its frames, transition by transition, so that neighbours are read together.

    Returns the distinct slots, as `FrameStore.unique` orders them, and obs_index and next_index into these.
    """
    distinct, index = frames.unique(columns.slots.take(rows, axis=0).astype(np.intp))
    np.add.at(columns.reuse, rows, np.int32(1))
    stack = index.shape[1] // 2
    return distinct, index[:, :stack].copy(), index[:, stack:].copy()


def largest(priorities: NDArray[np.float64]) -> float:
    """The largest, 0 if there are none; NaN if one is negative or not finite."""
    found = float(priorities.max(initial=0))
    return found if priorities.min(initial=0) >= 0 and found < np.inf else np.nan


def held(
    columns: Columns, size: int, ids: NDArray[Any], rows: Slots, priorities: NDArray[np.float64]
) -> tuple[Slots, NDArray[np.float64]]:
    """The rows, of the `size` lowest, that hold the transitions with these ids, and their priorities."""
    there = (rows < size) & (columns.ids.take(rows, mode="clip") == ids)
    return (rows, priorities) if there.all() else (rows[there], priorities[there])


PLAIN = Loops(put, gather, largest, held)


def compiled_loops() -> Loops:
    """The compiled functions, if this installation has them."""
    try:
        import coop.replay.table.compiled_loops as made  # noqa: PLC0415 (numba takes half a second, and 120 MiB)
    except ImportError:  # numba is not there, or does not fit the other packages
        return PLAIN
    return Loops(made.put, made.gather, made.largest, made.held)


def reuse_histogram(reuse: NDArray[np.int32]) -> NDArray[np.intp]:
    """Transitions by the bit length of their draws: int [REUSE_BUCKETS], the last entry open-ended."""
    return np.bincount(_BUCKETS.searchsorted(reuse, "right"), minlength=REUSE_BUCKETS)
