"""A table's statistics, and its snapshot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop.common.types import Array
from coop.replay.table.frames import PinnedFrames

REUSE_BUCKETS = 16
_BUCKETS = 2 ** np.arange(REUSE_BUCKETS - 1, dtype=np.int32)  # the fewest draws of each bucket but the first


@dataclass(frozen=True, slots=True)
class TableStats:
    """Counts since the table's beginning, and its present contents.

    inserted, evicted, evicted_unsampled: transitions (one that reservoir eviction never kept counts as evicted).
    batches, sampled: sample calls and transitions drawn.
    reuse_mean: draws per transition held. reuse_held, reuse_evicted: transitions by how often they have been drawn;
    entry 0 counts those never drawn, entry b those drawn 2^(b-1) to 2^b - 1 times, the last entry all above.
    """

    size: int
    inserted: int
    evicted: int
    evicted_unsampled: int
    batches: int
    sampled: int
    frames_held: int
    bytes_held: int
    reuse_mean: float
    reuse_held: tuple[int, ...]
    reuse_evicted: tuple[int, ...]


class TableSnapshot(NamedTuple):
    """A table's state at one moment, while the table stays in use.

    meta, arrays: as `Table.load_state` takes them, except the array "frames". frames: its content, to be read in pieces
    of any size between other calls on the table, and to be released at the end (it is a context manager).
    """

    meta: dict[str, Any]
    arrays: dict[str, Array]
    frames: PinnedFrames


def reuse_histogram(reuse: NDArray[np.int32]) -> NDArray[np.intp]:
    """Transitions by the bit length of their draws: int [REUSE_BUCKETS], the last entry open-ended."""
    return np.bincount(_BUCKETS.searchsorted(reuse, "right"), minlength=REUSE_BUCKETS)
