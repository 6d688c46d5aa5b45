"""Durable files: complete on the disk, or absent under their name; and what is moved aside instead of being deleted."""

from __future__ import annotations

import errno
import os
import secrets
import time
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from coop.common.errors import RunError
from coop.common.process.output import keep_standard_files
from coop.common.process.untrusted import no_links

NO_SPACE = (errno.ENOSPC, errno.EDQUOT)  # error numbers
PIECE = 1 << 24  # bytes read at once
_guards: list[Callable[[], None]] = []
ASIDE = "aside"  # folder in a run directory for what a resumed run does not go on with
_SEAL = b"\ncrc32 "  # between a sealed file's content and the checksum, in hexadecimal


class FileDigest(NamedTuple):
    """The size of a file, or of its beginning, in bytes, and the CRC-32 of these bytes."""

    size: int
    checksum: int


def guard_writes(check: Callable[[], None]) -> None:
    """Call `check` before each write of this process; it ends a process that may no longer write."""
    _guards.append(check)


def check_guards() -> None:
    """Ask everything that guards this process's writes; called before each."""
    for check in _guards:
        check()


class SyncedFile:
    """A new file whose content is on the disk when `close` returns.

    size, checksum: bytes written so far, and their CRC-32.
    """

    def __init__(self, path: Path) -> None:
        check_guards()
        keep_standard_files()
        self._file = open(path, "wb", buffering=0, opener=no_links)  # noqa: SIM115 (Path.open takes no opener)
        self.size = 0
        self.checksum = 0

    @property
    def measured(self) -> FileDigest:
        """Size and checksum of what was written."""
        return FileDigest(self.size, self.checksum)

    def write(self, data: bytes | memoryview) -> None:
        """Append bytes; raises OSError if there is no space for all of them."""
        view = memoryview(data)
        self.checksum = zlib.crc32(view, self.checksum)
        self.size += view.nbytes
        while view:
            view = view[self._file.write(view) :]

    def close(self) -> None:
        """Flush the file to the disk and close it."""
        if not self._file.closed:
            try:
                os.fsync(self._file.fileno())
            finally:
                self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        self._file.close()


class LineFile:
    """A file that grows by whole lines or records; data that do not fit on the disk are kept, and written later.

    problem: why lines are being kept; empty if none are. measured: all lines, those that are kept included.
    """

    def __init__(self, path: Path, *, go_on: bool) -> None:
        self.problem = ""
        self.measured = measure(path) if go_on and path.exists() else FileDigest(0, 0)
        self._late = b""
        keep_standard_files()
        mode = "ab" if go_on else "wb"
        self._file = open(path, mode, buffering=0, opener=no_links)  # noqa: SIM115 (Path.open takes no opener)

    def write(self, text: str) -> None:
        """Append text that ends with a newline."""
        self.append(text.encode())

    def append(self, data: bytes) -> None:
        """Append the bytes of one line or record."""
        check_guards()
        self._late += data
        size, checksum = self.measured
        self.measured = FileDigest(size + len(data), zlib.crc32(data, checksum))
        try:
            self.finish()
            self.problem = ""
        except OSError as error:
            self.problem = error.strerror or str(error)

    def finish(self) -> None:
        """Write the kept data; raises OSError if there is still no space."""
        while self._late:
            self._late = self._late[self._file.write(self._late) :]

    def sync(self) -> None:
        """Write the kept data, and flush the file to the disk; raises OSError."""
        self.finish()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Try once more to write kept lines, and close the file."""
        self.append(b"")
        self._file.close()


def part_of(path: Path) -> Path:
    """Where to write what `path` is to be: nobody else's, as others may write the same now, or have such a name."""
    return path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")


def write_atomic(path: Path, data: bytes) -> FileDigest:
    """Replace a file atomically and durably. Raises OSError, and then leaves the old file untouched."""
    part = part_of(path)
    try:
        with SyncedFile(part) as file:
            file.write(data)
        part.replace(path)
        sync_folder(path.parent)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return file.measured


def make_folder(path: Path) -> None:
    """Create a folder with its parents, durably, if it does not exist; raises OSError."""
    if path.is_dir():
        return
    if not path.parent.exists():
        make_folder(path.parent)
    path.mkdir(exist_ok=True)
    sync_folder(path.parent)


def truncate(path: Path, size: int) -> None:
    """Shorten a file to `size` bytes.

    Raises:
        RunError: it is already shorter, so data have been lost that cannot be replaced; or it is a link.
        OSError: it cannot be written.
    """
    there = path.stat().st_size
    if there < size:
        raise RunError(f"{path}: has {there:,} bytes, and should have at least {size:,}")
    if path.is_symlink():
        raise RunError(f"{path}: is a link, which is not followed")
    if there > size:
        os.truncate(path, size)


def measure(path: Path, size: int | None = None) -> FileDigest:
    """Measure a file, or its first `size` bytes; raises OSError."""
    done = checksum = 0
    with path.open("rb") as file:
        while piece := file.read(PIECE if size is None else min(PIECE, size - done)):
            done += len(piece)
            checksum = zlib.crc32(piece, checksum)
    return FileDigest(done, checksum)


def sealed(data: bytes) -> bytes:
    """The content of a small file, followed by its checksum, for `unsealed`."""
    return data + _SEAL + f"{zlib.crc32(data):08x}\n".encode()


def unsealed(content: bytes) -> bytes:
    """The data of `sealed`; raises ValueError if the checksum is missing or differs."""
    data, seal, _ = content.rpartition(_SEAL)
    if not seal or content != sealed(data):
        raise ValueError("wrong checksum")
    return data


def sync_file(path: Path) -> int:
    """Flush a file that is being written elsewhere to the disk; return its size in bytes. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
        return os.fstat(descriptor).st_size
    finally:
        os.close(descriptor)


def sync_all(folder: Path) -> None:
    """Flush a folder, with all files and folders in it, to the disk; raises OSError."""
    for path in (*folder.rglob("*"), folder):
        sync_file(path)


def sync_folder(path: Path) -> None:
    """Flush a folder's entries to the disk; raises OSError."""
    sync_file(path)


def aside_folder(folder: Path) -> Path:
    """A new folder `aside/TIME` in a run directory, for what is moved aside; raises OSError."""
    stamp, number = time.strftime("%Y%m%d-%H%M%S"), 0
    while True:
        path = folder / ASIDE / (f"{stamp}-{number}" if number else stamp)
        try:
            make_folder(path.parent)
            path.mkdir()
        except FileExistsError:
            number += 1
        else:
            return path


def move_aside(folder: Path, names: Iterable[str], to: Path) -> None:
    """Move files and folders of `folder` that exist, by their relative paths, to the same paths in `to`.

    Raises OSError.
    """
    for name in names:
        source = folder / name
        if source.exists() or source.is_symlink():
            make_folder((to / name).parent)
            source.rename(to / name)
            sync_folder((to / name).parent)
            sync_folder(source.parent)
