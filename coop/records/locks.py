"""Locks of a folder that are released when their holders end, however they end.

A lock is `flock` on an open file, which the kernel releases with its last holder: where all who may want the folder
run on one kernel, that is all. Other file systems may be shared by hosts, and their mounts may keep locks to
themselves. There the file also holds a lease: a random token of its owner, who touches the file every `BEAT` seconds.
Nothing rests on process ids or host names, which repeat between containers.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from coop.common.errors import RunError
from coop.common.process.files import guard_writes, make_folder
from coop.common.process.output import complain, keep_standard_files
from coop.common.process.processes import INHERITED
from coop.common.process.untrusted import check_links

HOLDER_BYTES = 512  # more than any holder's line
BEAT = 2.0  # seconds between an owner's touches
LEASE = 15.0  # seconds without a touch after which an owner is dead; more than a network file system's caches hold
LOOK, LOOKS = 0.02, 5  # seconds after which who looks whether a lock is held has let go of it; times that it is tried
SETTLE = 1.0  # seconds in which the claims of several hosts overwrite each other; the last one holds
# File systems that only one kernel mounts at a time, so that all processes that see a file see its locks.
LOCAL = frozenset({"bcachefs", "btrfs", "ext2", "ext3", "ext4", "f2fs", "jfs", "ramfs", "tmpfs", "xfs", "zfs"})
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
_OPEN = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK  # neither through a link nor into a pipe


class FileLock:
    """A lock on one file. A child process that inherits `descriptor` holds it too."""

    def __init__(self, path: Path, holder: str = "", inherited: int | None = None) -> None:
        """Acquire the lock, or take part in the one whose descriptor this process has inherited.

        holder: a line in the file, for the error message of other processes.

        Raises:
            BlockingIOError: another process holds it.
            OSError: the file cannot be made.
        """
        self.path = path
        self.signed = False
        self._before = b""
        self.inherited = inherited is not None
        self.leased = not _is_local(path.parent)
        self._seen = _now()
        if inherited is not None:
            self.descriptor = inherited
            self._token = _read(path)[1]
        else:
            keep_standard_files()  # children's logs replace theirs
            self._token = secrets.token_hex(16)
            self.descriptor = os.open(path, _OPEN, 0o644)
            try:
                self._claim(holder, alone=self._flock())
            except BaseException:
                os.close(self.descriptor)
                raise
        if self.leased:
            _heart.add(self)

    def _flock(self) -> bool:
        """Lock the file; False where the file system has no such locks, so that the lease alone decides."""
        for left in reversed(range(LOOKS)):
            try:
                fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return True
            except BlockingIOError:
                if not left:
                    raise
                time.sleep(LOOK)
            except OSError as error:
                if not self.leased or error.errno not in _NO_LOCKS:
                    raise
                return False
        raise AssertionError

    def _claim(self, holder: str, *, alone: bool) -> None:
        """Write this owner into the file, once no other owner can be alive. alone: on this kernel none is."""
        _, token, place = _read(self.path)
        if self.leased and token and not (alone and place == _place(self.descriptor)):
            end, touched = _now() + LEASE, _touched(self.path)
            while _now() < end:
                time.sleep(LEASE / 10)
                if _touched(self.path) != touched or _read(self.path)[1] != token:
                    raise BlockingIOError
        self._before = os.pread(self.descriptor, 2 * HOLDER_BYTES, 0)
        line = holder.encode()[:HOLDER_BYTES]
        content = b"\n".join([line.replace(b"\n", b" "), self._token.encode(), _place(self.descriptor).encode(), b""])
        os.pwrite(self.descriptor, content, 0)
        os.ftruncate(self.descriptor, len(content))
        if self.leased:
            os.fsync(self.descriptor)
            time.sleep(SETTLE)
            if _read(self.path)[1] != self._token:
                raise BlockingIOError

    def beat(self) -> None:
        """Check that the file still names this owner, and touch it; end the process if it names another one."""
        try:
            found = _read(self.path)[1]
            if found and found != self._token:
                with contextlib.suppress(OSError):
                    complain(
                        f"error: run directory {self.path.parent}: another process has taken it over while this one "
                        "stood still"
                    )
                os._exit(RunError.exit_status)  # at once: whatever this process would still write is no longer its own
            os.utime(self.descriptor)
            self._seen = _now()
        except OSError:
            return  # the file system does not answer; the next beat looks again

    def check(self) -> None:
        """As `beat`, if the last one was so long ago that another process may believe that this one is dead."""
        if _now() - self._seen > LEASE / 2:
            self.beat()

    def hand_over(self) -> None:
        """Leave the lock to the child processes that have inherited it."""
        _heart.drop(self)
        if not self.inherited:
            with contextlib.suppress(OSError):  # users' code has closed it
                os.close(self.descriptor)

    def release(self) -> None:
        """Release the lock, unless this process has only inherited it; the file is as it was if it was not signed."""
        if not self.inherited and (not self.leased or _read(self.path)[1] == self._token):
            with contextlib.suppress(OSError):
                content = b"" if self.signed else self._before
                os.pwrite(self.descriptor, content, 0)
                os.ftruncate(self.descriptor, len(content))
            with contextlib.suppress(OSError):
                fcntl.flock(self.descriptor, fcntl.LOCK_UN)  # not by closing it: users' code may have forked
        self.hand_over()


class _Heart:
    """Touches the leased locks of this process, in a thread of its own while there are any."""

    def __init__(self) -> None:
        self.locks: tuple[FileLock, ...] = ()
        self._changing = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def add(self, lock: FileLock) -> None:
        with self._changing:
            self.locks = (*self.locks, lock)
            if self._thread is None:
                self._stop.clear()
                self._thread = threading.Thread(target=self._run, name="leases", daemon=True)
                self._thread.start()

    def drop(self, lock: FileLock) -> None:
        with self._changing:
            self.locks = tuple(other for other in self.locks if other is not lock)
            if not self.locks and self._thread is not None:
                self._stop.set()
                self._thread.join()
                self._thread = None

    def _run(self) -> None:
        while not self._stop.wait(BEAT):
            for lock in self.locks:
                lock.beat()


_heart = _Heart()


def check_held() -> None:
    """End the process if another one has taken over a lock of it. Called before each write; costs a look at a clock."""
    for lock in _heart.locks:
        lock.check()


guard_writes(check_held)


class RunLock:
    """Locks the roles' places in a run directory for one process and the children that inherit its locks.

    Learner and replay service may share a directory; a process that acts as both locks both places.
    """

    def __init__(self, folder: Path, program: str, roles: Sequence[str]) -> None:
        """Lock the places of `roles`; create the folder if it does not exist. see `sign`.

        Raises:
            RunError: another process, which the message names, holds one of them, or the folder cannot be written.
        """
        self._locks: list[FileLock] = []
        self._holder = f"{program} on {socket.gethostname()} (pid {os.getpid()})"
        try:
            make_folder(folder)
            check_links(folder)
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
        """Keep this process named in the locks' files; until then, releasing them leaves them as they were."""
        for lock in self._locks:
            lock.signed = True
        return self

    def hand_over(self) -> None:
        """Leave all locks to the child processes that have inherited them."""
        for lock in self._locks:
            lock.hand_over()
        self._locks.clear()

    def release(self) -> None:
        """Release all locks."""
        for lock in self._locks:
            lock.release()
        self._locks.clear()

    def _take(self, folder: Path, role: str) -> None:
        path = folder / f".{role}.lock"
        try:
            self._locks.append(FileLock(path, self._holder, _inherited(path)))
        except BlockingIOError:
            raise LockHeld(f"run directory {folder}: in use by {_read(path)[0] or 'another process'}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


class LockHeld(RunError):
    """Another process, which the message names, works in the run directory."""


def _inherited(path: Path) -> int | None:
    """The descriptor of the lock of `path` if this process inherited it from its supervisor."""
    for number in filter(None, os.environ.get(INHERITED, "").split(",")):
        try:
            if os.path.samestat(os.fstat(int(number)), path.lstat()):
                return int(number)
        except (OSError, ValueError):
            continue
    return None


def _read(path: Path) -> tuple[str, str, str]:
    """(holder, token, place) in a lock's file; empty where it has none. Opens it anew: that refreshes caches."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            text = os.read(descriptor, 2 * HOLDER_BYTES).decode(errors="replace")
        finally:
            os.close(descriptor)
    except OSError:
        text = ""
    holder, token, place, *_ = [*text.split("\n"), "", "", ""]
    return holder, token, place


def _touched(path: Path) -> int:
    """When a file was last touched, by its server's clock."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        return os.fstat(descriptor).st_mtime_ns
    finally:
        os.close(descriptor)


def _place(descriptor: int) -> str:
    """The running kernel and the file as it sees it: where both are the same, `flock` alone decides."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
    except OSError:
        boot = secrets.token_hex(8)  # unknown, so never the same
    found = os.fstat(descriptor)
    return f"{boot} {found.st_dev}:{found.st_ino}"


def _is_local(folder: Path) -> bool:
    """Whether only this kernel can have mounted the file system of a folder."""
    try:
        mounts = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return False
    there, best, kind = folder.resolve(), Path(), ""
    for line in mounts:
        fields, _, source = line.partition(" - ")
        place = Path(re.sub(r"\\(\d{3})", lambda code: chr(int(code[1], 8)), fields.split()[4]))  # for a space
        if there.is_relative_to(place) and len(place.parts) >= len(best.parts):
            best, kind = place, source.split()[0]
    return kind in LOCAL


def _now() -> float:
    """Seconds, those in which the machine was suspended included, as macOS counts its monotonic clock's."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def holder(folder: Path, role: str = "learner") -> tuple[str, bool]:
    """Who works in a run's folder: "coop-local on head (pid 7)", and whether it does.

    Empty where nobody has signed the lock, or the last one released it; False where the last one has been killed. Asks
    the lock itself: lists of its owners, as /proc/locks, leave out those of other containers.
    """
    path = folder / f".{role}.lock"
    line = _read(path)[0]
    if not line:
        return "", False
    try:
        return line, _is_held(path) or (not _is_local(folder) and time.time() - _touched(path) / 1e9 < LEASE)
    except OSError:
        return line, True  # as it says


def _is_held(path: Path) -> bool:
    """Whether a process of this kernel holds the lock on a file."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        fcntl.flock(descriptor, fcntl.LOCK_UN)  # not by closing it: a process forked meanwhile has it open
    except BlockingIOError:
        return True
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    finally:
        os.close(descriptor)
    return False
