"""Durable files: complete on the disk, or absent under their name."""

from __future__ import annotations

import errno
import os
import zlib
from pathlib import Path
from types import TracebackType
from typing import Self

from common.errors import RunError
from common.process.locks import check_held
from common.process.output import keep_standard_files
from common.process.untrusted import no_links

NO_SPACE = (errno.ENOSPC, errno.EDQUOT)  # error numbers
PIECE = 1 << 24  # bytes read at once


class SyncedFile:
    """A new file whose content is on the disk when `close` returns.

    size, checksum: bytes written so far, and their CRC-32.
    """

    def __init__(self, path: Path) -> None:
        check_held()
        keep_standard_files()
        self._file = open(path, "wb", buffering=0, opener=no_links)  # noqa: SIM115 (Path.open takes no opener)
        self.size = 0
        self.checksum = 0

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
            os.fsync(self._file.fileno())
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

    problem: why lines are being kept; empty if none are.
    """

    def __init__(self, path: Path, *, go_on: bool) -> None:
        self.problem = ""
        self._late = b""
        keep_standard_files()
        mode = "ab" if go_on else "wb"
        self._file = open(path, mode, buffering=0, opener=no_links)  # noqa: SIM115 (Path.open takes no opener)

    def write(self, text: str) -> None:
        """Append text that ends with a newline."""
        self.append(text.encode())

    def append(self, data: bytes) -> None:
        """Append the bytes of one line or record."""
        check_held()
        self._late += data
        try:
            self.finish()
            self.problem = ""
        except OSError as error:
            self.problem = error.strerror or str(error)

    def finish(self) -> None:
        """Write the kept data; raises OSError if there is still no space."""
        while self._late:
            self._late = self._late[self._file.write(self._late) :]

    def close(self) -> None:
        """Try once more to write kept lines, and close the file."""
        self.append(b"")
        self._file.close()


def write_atomic(path: Path, data: bytes) -> int:
    """Replace a file atomically; return the new CRC-32. Raises OSError, and then leaves the old file untouched."""
    part = path.with_name(path.name + ".part")
    try:
        with SyncedFile(part) as file:
            file.write(data)
        part.replace(path)
        sync_folder(path.parent)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    return file.checksum


def truncate(path: Path, size: int) -> None:
    """Shorten a file to `size` bytes.

    Raises:
        RunError: it is already shorter, so data have been lost that cannot be replaced.
        OSError: it cannot be written.
    """
    there = path.stat().st_size
    if there < size:
        raise RunError(f"{path}: has {there:,} bytes, and should have at least {size:,}")
    os.truncate(path, size)


def measure(path: Path) -> tuple[int, int]:
    """(bytes, CRC-32) of a file; raises OSError."""
    size = checksum = 0
    with path.open("rb") as file:
        while piece := file.read(PIECE):
            size += len(piece)
            checksum = zlib.crc32(piece, checksum)
    return size, checksum


def sync_folder(path: Path) -> None:
    """Flush a folder's entries to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def user_path(text: str | Path) -> Path:
    """A path as users write it: ~ is their home; raises ValueError for an empty one, which would be this folder."""
    if not str(text):
        raise ValueError("an empty path; this folder is .")
    return Path(text).expanduser()
