"""Memory of this process: rows that grow in place, and how the C library treats freed memory."""

from __future__ import annotations

import ctypes
import mmap
from functools import cache

import numpy as np

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's mallopt
_KEEP = 2**30  # bytes


@cache
def keep_freed_memory() -> None:
    """Make glibc keep freed memory in this process; does nothing with another C library.

    Updates allocate and free tensors of ten megabytes and more, messages of one. By default glibc returns them to the
    kernel each time; mapping and zeroing their pages again takes a third of an update of a convolutional network.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, _KEEP)
        mallopt(_MMAP_THRESHOLD, _KEEP)


def return_freed_memory() -> None:
    """Return to the kernel what this process has freed, for after a checkpoint, which needs memory that updates do not.

    Takes milliseconds. Does nothing without glibc.
    """
    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if malloc_trim is not None:
        malloc_trim(0)


class GrowingRows:
    """Rows of equal size in one mapping that is enlarged in place; memory is committed page by page as it is written.

    Args:
        memory: the mapping, if it is to be a certain one.

    Attributes:
        view: void [rows]; a row is one item, which numpy copies fastest. Callers must keep no view of it.
    """

    def __init__(self, row_bytes: int, rows: int, memory: mmap.mmap | None = None) -> None:
        self.dtype = np.dtype((np.void, row_bytes))
        size = rows * row_bytes
        self._memory = memory or mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        self.view = np.frombuffer(self._memory, self.dtype, rows)

    def grow(self, rows: int) -> None:
        """Make it `rows` rows; raises OSError, and then has changed nothing, if there is no room."""
        del self.view  # a mapping cannot be moved while a view on it exists
        try:
            self._memory.resize(rows * self.dtype.itemsize)
        finally:
            self.view = np.frombuffer(self._memory, self.dtype)
