"""How the C library treats freed memory."""

from __future__ import annotations

import ctypes
from functools import cache

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
