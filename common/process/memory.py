"""Memory of this process: how much its job may use, rows that grow in place, how the C library treats freed memory."""

from __future__ import annotations

import ctypes
import mmap
import os
from contextlib import suppress
from functools import cache
from pathlib import Path

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


def job_memory(root: Path = Path("/")) -> int:
    """Bytes that this process may use: this machine's memory, or less if a control group limits its job.

    root: where /proc and /sys are, for tests.
    """
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    groups = ""
    with suppress(OSError):
        groups = (root / "proc/self/cgroup").read_text(encoding="utf-8")
    for line in groups.splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers in ("", "memory"):
            top, name = (
                ("sys/fs/cgroup/memory", "memory.limit_in_bytes") if controllers else ("sys/fs/cgroup", "memory.max")
            )
            group = Path(path.lstrip("/"))
            for each in (group, *group.parents):  # a limit holds for all groups below it
                with suppress(OSError, ValueError):  # no such group in this container; "max"
                    limits.append(int((root / top / each / name).read_text(encoding="utf-8")))
    return min(limits)


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
