"""Locks of a folder that the operating system releases when their holders end, however they end."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from common.errors import RunError
from common.process.files import make_folder

INHERITED = "COOP_LOCKS"  # comma-separated descriptors of locks that a process inherits from its supervisor
HOLDER_BYTES = 512  # more than any holder's line


class FileLock:
    """A lock on one file. A child process that inherits `descriptor` holds it too."""

    def __init__(self, path: Path) -> None:
        """Acquire the lock; raises BlockingIOError if another process holds it, OSError if the file cannot be made."""
        self.descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.release()
            raise

    def name_holder(self, holder: str) -> None:
        """Write the holder into the file, for the error message of other processes."""
        os.ftruncate(self.descriptor, 0)
        os.pwrite(self.descriptor, holder.encode()[:HOLDER_BYTES], 0)

    def release(self) -> None:
        """Release the lock, unless a child process has inherited it."""
        os.close(self.descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


class RunLock:
    """Locks the roles' places in a run directory for one process and the children that inherit its locks.

    Learner and replay service may share a directory; a process that acts as both locks both places.
    """

    def __init__(self, folder: Path, program: str, roles: Sequence[str]) -> None:
        """Lock the places of `roles`; create the folder if it does not exist. `sign` names this process in them.

        Raises:
            RunError: another process, which the message names, holds one of them, or the folder cannot be written.
        """
        self._locks: list[FileLock] = []
        self._holder = f"{program} on {socket.gethostname()} (pid {os.getpid()})"
        try:
            make_folder(folder)
            for role in roles:
                self._take(folder, role)
        except OSError as error:
            self.release()
            raise RunError(f"run directory {folder}: {error.strerror or error}") from error
        except RunError:
            self.release()
            raise

    @property
    def descriptors(self) -> tuple[int, ...]:
        """The descriptors that a child must inherit, and find in the variable `INHERITED`, to hold the locks too."""
        return tuple(lock.descriptor for lock in self._locks)

    def sign(self) -> Self:
        """Name this process to others that want the directory; before, the locks' files are as they were."""
        for lock in self._locks:
            lock.name_holder(self._holder)
        return self

    def release(self) -> None:
        """Release all locks."""
        for lock in self._locks:
            lock.release()
        self._locks.clear()

    def _take(self, folder: Path, role: str) -> None:
        path = folder / f".{role}.lock"
        if _is_inherited(path):
            return  # the supervisor holds it and is named in it
        try:
            lock = FileLock(path)
        except BlockingIOError:
            holder = path.read_text(encoding="utf-8", errors="replace") or "another process"
            raise RunError(f"run directory {folder}: in use by {holder}") from None
        self._locks.append(lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def _is_inherited(path: Path) -> bool:
    """Whether this process inherited the lock of `path` from its supervisor."""
    for number in filter(None, os.environ.get(INHERITED, "").split(",")):
        try:
            if os.path.samestat(os.fstat(int(number)), path.stat()):
                return True
        except (OSError, ValueError):
            continue
    return False
