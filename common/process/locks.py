"""Locks of a folder that are free as soon as the processes that hold them have ended, however they ended."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from common.errors import RunError

INHERITED = "COOP_LOCKS"  # descriptors of locks that a process has from its supervisor, separated by commas
HOLDER_BYTES = 512  # more than any line that names a holder


class FileLock:
    """The lock of one file. A child process that inherits `descriptor` holds it too."""

    def __init__(self, path: Path) -> None:
        """Take the lock; raises BlockingIOError where another process has it, and OSError where the file can't be."""
        self.descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.release()
            raise

    def name_holder(self, holder: str) -> None:
        """Write down who holds the lock, for those who are refused."""
        os.ftruncate(self.descriptor, 0)
        os.pwrite(self.descriptor, holder.encode()[:HOLDER_BYTES], 0)

    def release(self) -> None:
        """Give the lock up, unless a child process has inherited it."""
        os.close(self.descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


class RunLock:
    """The places in a run directory that one process, and the children that it hands its locks to, works in.

    Learner and replay service may share a directory; what takes the place of both locks both.
    """

    def __init__(self, folder: Path, program: str, roles: Sequence[str]) -> None:
        """Lock the places of `roles`; the folder is made if it is not there.

        Raises:
            RunError: another process works in one of them (named), or the folder can't be written.
        """
        self._locks: list[FileLock] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for role in roles:
                self._take(folder, role, program)
        except OSError as error:
            self.release()
            raise RunError(f"run directory {folder}: {error.strerror or error}") from error
        except RunError:
            self.release()
            raise

    @property
    def descriptors(self) -> tuple[int, ...]:
        """What a child process must inherit, and be told of in `INHERITED`, to hold the locks too."""
        return tuple(lock.descriptor for lock in self._locks)

    def release(self) -> None:
        """Let others in."""
        for lock in self._locks:
            lock.release()
        self._locks.clear()

    def _take(self, folder: Path, role: str, program: str) -> None:
        path = folder / f".{role}.lock"
        if _is_inherited(path):
            return  # the supervisor's, which has named itself
        try:
            lock = FileLock(path)
        except BlockingIOError:
            holder = path.read_text(encoding="utf-8", errors="replace") or "another process"
            raise RunError(f"run directory {folder}: in use by {holder}") from None
        lock.name_holder(f"{program} on {socket.gethostname()} (pid {os.getpid()})")
        self._locks.append(lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def _is_inherited(path: Path) -> bool:
    """Whether this process has the lock of `path` from its supervisor."""
    for number in filter(None, os.environ.get(INHERITED, "").split(",")):
        try:
            if os.path.samestat(os.fstat(int(number)), path.stat()):
                return True
        except (OSError, ValueError):
            continue
    return False
