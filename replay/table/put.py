"""How a segment's transitions come into the rows that a policy has given them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

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


Put = Callable[[FrameStore, StreamTails, Columns, NDArray[np.int64], Placed], int]


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


def compiled_put() -> Put | None:
    """The same in a compiled loop, if this installation has one; both give the same bits."""
    try:
        from coop.replay.table.compiled_put import put  # noqa: PLC0415 (numba takes half a second, and 120 MiB)
    except ImportError:  # numba is not there, or does not fit the other packages
        return None
    return put


def reuse_histogram(reuse: NDArray[np.int32]) -> NDArray[np.intp]:
    """Transitions by the bit length of their draws: int [REUSE_BUCKETS], the last entry open-ended."""
    return np.bincount(_BUCKETS.searchsorted(reuse, "right"), minlength=REUSE_BUCKETS)
