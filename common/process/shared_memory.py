"""Memory that one process writes and others of its user, on its machine, read in place.

It is an anonymous file. Its address names the process and the descriptor that hold it open, which others reach through
/proc, and a random name, which tells them that they have found it. The kernel frees it once nobody maps it.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import secrets
import weakref
from pathlib import Path

ADDRESS = r"^[0-9]{1,10}/[0-9]{1,10}/coop-[0-9a-f]{32}$"


class SharedMemory:
    """Memory to write; `mapped` may be enlarged, but never made smaller, which would kill its readers."""

    def __init__(self, size: int) -> None:
        """Raise OSError if there is not so much memory, or if the system has no such files."""
        if not hasattr(os, "memfd_create"):
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        name = f"coop-{secrets.token_hex(16)}"
        file = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        weakref.finalize(self, os.close, file)
        os.ftruncate(file, size)
        fcntl.fcntl(file, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        self.mapped = mmap.mmap(file, size)
        self.address = f"{os.getpid()}/{file}/{name}"


class SharedMemoryReader:
    """Another process's `SharedMemory`, read-only, which stays as it was last written when that process ends."""

    def __init__(self, address: str) -> None:
        """Raise OSError if this process does not reach it."""
        process, number, name = address.split("/")
        self._file = os.open(f"/proc/{process}/fd/{number}", os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        weakref.finalize(self, os.close, self._file)
        if str(Path(f"/proc/self/fd/{self._file}").readlink()) != f"/memfd:{name} (deleted)":
            raise FileNotFoundError(f"{address}: the descriptor is that of another file")  # also on another machine
        if not fcntl.fcntl(self._file, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
            raise PermissionError(f"{address}: it could be made smaller")

    def map(self) -> mmap.mmap:
        """Map the memory at its present size."""
        return mmap.mmap(self._file, 0, prot=mmap.PROT_READ)
