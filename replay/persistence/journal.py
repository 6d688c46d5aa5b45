"""The journal: every accepted segment and every draw, in order, appended to files before anybody is answered.

A file is a row of records `[u32 checksum][u32 kind][u64 number][u64 length][payload]`; the first names the run and the
file. What was handed to the operating system survives a kill -9 of this process, so records are written, not synced.
Files that are not needed any more are written over: their pages are in memory already, which saves half of the time.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import msgpack
import msgspec
import numpy as np
from numpy.typing import NDArray

from common.errors import RunError, UsageError
from common.messaging.messages.sample import DrawRequest
from common.process.run_ids import check_owner
from replay.limiter import RateLimiter

FORMAT = 1
BEGIN, SEGMENT, DRAW, LIMITER, END = range(5)
BEGIN_BYTES = 64  # more than the record that names a file holds
ROLL_AT = 1 << 28  # bytes after which a new file is begun

_HEADER = struct.Struct("<IIQQ")
_LANES = 1024  # columns of 64 bits that a checksum adds up
_SPARE = "spare"  # a file that is to be written over


class TornFile(RunError):
    """A journal file that ends in something that is no whole record; `end` is where the whole ones end, in bytes."""

    def __init__(self, path: Path, end: int) -> None:
        super().__init__(f"{path}: no whole record at byte {end}")
        self.path = path
        self.end = end


class Record(NamedTuple):
    """One entry of a journal."""

    kind: int
    payload: bytes


class Journal:
    """Appends to the journal in `folder`; a `Recorder` of the replay service's core.

    Args:
        number: of the file to begin.
        keep: never drop files.
    """

    def __init__(self, folder: Path, run_id: int, number: int, *, keep: bool) -> None:
        """Raises OSError where the file can't be begun."""
        self._folder = folder
        self._run_id = run_id
        self._keep = keep
        self._late: list[tuple[int, bytes]] = []  # records of draws that there was no space for
        folder.mkdir(parents=True, exist_ok=True)
        self._open(number)

    def insert(self, payload: bytes) -> None:
        """Take down an insert request; raises OSError, and nothing was taken down then."""
        self._append(SEGMENT, payload)

    def draw(self, request: DrawRequest, ids: NDArray[np.int64]) -> None:
        """Take down a draw. Without space it is kept and goes before whatever is taken down next."""
        self._late.append((DRAW, msgpack.packb([*msgspec.structs.astuple(request), ids.tobytes()])))
        with contextlib.suppress(OSError):
            self._append_late()

    def limit(self, limiter: RateLimiter) -> None:
        """Take down new settings of the limiter; raises OSError."""
        self._append(LIMITER, msgpack.packb(asdict(limiter)))

    def roll(self) -> int:
        """Begin the next file, whose number is returned; raises OSError, and this file goes on then."""
        self._append_late()
        self._write(END, b"")  # behind it may be what is left of an older file
        before = self._file
        try:
            self._open(self._number + 1)
        except OSError:
            self._end -= _HEADER.size
            self._records -= 1
            raise
        os.close(before)
        return self._number

    def drop(self, before: int) -> None:
        """Give up the files with lower numbers, unless all are to be kept."""
        for number in () if self._keep else journal_files(self._folder):
            if number < before:
                _path(self._folder, number).replace(self._folder / _SPARE)

    def _open(self, number: int) -> None:
        path = _path(self._folder, number)
        payload = msgpack.packb([FORMAT, self._run_id, number])
        with contextlib.suppress(FileNotFoundError):
            (self._folder / _SPARE).rename(path)
        file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
        try:
            end = _write(file, 0, BEGIN, number, 0, payload)
        except OSError:
            os.close(file)
            path.unlink()
            raise
        self._file, self._number, self._records, self._end = file, number, 1, end

    def _append(self, kind: int, payload: bytes) -> None:
        if self._end > ROLL_AT:
            self.roll()
        self._append_late()
        self._write(kind, payload)

    def _append_late(self) -> None:
        while self._late:
            self._write(*self._late[0])
            del self._late[0]

    def _write(self, kind: int, payload: bytes) -> None:
        try:
            self._end = _write(self._file, self._end, kind, self._number, self._records, payload)
        except OSError:
            if not (self._folder / _SPARE).exists():
                raise
            (self._folder / _SPARE).unlink()
            self._end = _write(self._file, self._end, kind, self._number, self._records, payload)
        self._records += 1


def _write(file: int, at: int, kind: int, number: int, place: int, payload: bytes) -> int:
    """Write one record; the offset behind it. Raises OSError, the file ending at `at` then."""
    header = _HEADER.pack(_checksum(kind, number, place, payload), kind, place, len(payload))
    try:
        written = os.pwritev(file, [header, payload], at)
        if written < len(header) + len(payload):  # cut short, most likely by a disk that is full: the rest tells
            written += os.pwrite(file, (header + payload)[written:], at + written)
        if written < len(header) + len(payload):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError:
        with contextlib.suppress(OSError):
            os.ftruncate(file, at)
        raise
    return at + written


def journal_files(folder: Path) -> list[int]:
    """Numbers of a journal's files, in ascending order."""
    return sorted(int(path.stem) for path in folder.glob("*.log"))


def drop_journal(folder: Path) -> None:
    """Drop every file of a journal; raises OSError."""
    for number in journal_files(folder):
        _path(folder, number).unlink()


def read_file(folder: Path, number: int, run_id: int) -> Iterator[Record]:
    """The records of one file, but for the one that names it.

    Raises:
        UsageError: the file is of another format.
        TornFile: what follows the records given is no whole one.
        RunError: it can't be read, or belongs to another run.
    """
    path = _path(folder, number)
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            end = 0
            for expected in itertools.count():
                if end == size:
                    return
                header = file.read(_HEADER.size).ljust(_HEADER.size)
                checksum, kind, place, length = _HEADER.unpack(header)
                payload = file.read(length) if end + _HEADER.size + length <= size else b""
                if (place, len(payload)) != (expected, length) or _checksum(kind, number, place, payload) != checksum:
                    raise TornFile(path, end)
                end = file.tell()
                if kind == END:
                    return
                if kind == BEGIN:
                    _check_begin(path, payload, run_id)
                else:
                    yield Record(kind, payload)
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error


def read_owner(folder: Path, number: int) -> int | None:
    """The id of the run that a file belongs to; None where the file is torn before it tells."""
    try:
        with _path(folder, number).open("rb") as file:
            header = file.read(_HEADER.size)
            checksum, kind, place, length = _HEADER.unpack(header.ljust(_HEADER.size))
            payload = file.read(min(length, BEGIN_BYTES))
    except OSError as error:
        raise RunError(f"{_path(folder, number)}: {error.strerror or error}") from error
    if kind != BEGIN or _checksum(kind, number, place, payload) != checksum:
        return None
    return int(msgpack.unpackb(payload)[1])


def _check_begin(path: Path, payload: bytes, run_id: int) -> None:
    version, found, _ = msgpack.unpackb(payload)
    if version != FORMAT:
        raise UsageError(f"{path}: format {version} of the journal, this program reads {FORMAT}")
    check_owner(path, found, run_id)


def read_draw(payload: bytes) -> tuple[DrawRequest, NDArray[np.int64]]:
    """A draw as it was taken down: the request, and the transitions that it gave."""
    *request, ids = msgpack.unpackb(payload)
    return DrawRequest(*request), np.frombuffer(ids, np.int64)


def read_limiter(payload: bytes) -> RateLimiter:
    """Settings of the limiter as they were taken down."""
    return RateLimiter.from_table(msgpack.unpackb(payload))


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:08}.log"


def _checksum(kind: int, number: int, place: int, payload: bytes) -> int:
    """CRC-32 over sums of the payload's 64-bit columns: a tenth of the time of CRC-32 over all of it.

    number, place: of the file and in it, so that what an older file left behind does not pass for a record.
    """
    whole = len(payload) // (8 * _LANES) * 8 * _LANES
    lanes = np.frombuffer(payload, np.uint64, whole // 8).reshape(-1, _LANES).sum(axis=0, dtype=np.uint64)
    return zlib.crc32(
        payload[whole:], zlib.crc32(lanes.tobytes(), zlib.crc32(struct.pack("<IQQ", kind, number, place)))
    )
