"""What the C library does with freed memory."""

from __future__ import annotations

import ctypes
from functools import cache

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of glibc's mallopt
_KEEP = 2**30  # bytes


@cache
def keep_freed_memory() -> None:
    """Let this process keep what it frees; where the C library is not glibc, nothing happens.

    Updates allocate and free tensors of ten megabytes and more, messages a megabyte. glibc hands them back to the
    kernel each time, and their pages, mapped in and zeroed again, cost a third of an update of a convolutional network.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, _KEEP)
        mallopt(_MMAP_THRESHOLD, _KEEP)
