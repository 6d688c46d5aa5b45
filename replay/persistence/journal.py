"""The journal: every accepted segment and every draw, appended to files in order before the request is answered.

A file is a sequence of records `[u32 checksum][u32 kind][u64 number][u64 length][payload]`; the first record names the
run and the file. Data handed to the operating system survive a kill -9 of this process, so records are written but not
synced. Files that are no longer needed are overwritten: their pages are in memory already, which halves the time.
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
BEGIN_BYTES = 64  # more than the record that names a file
ROLL_AT = 1 << 28  # bytes after which the next file begins

_HEADER = struct.Struct("<IIQQ")
_LANES = 1024  # 64-bit columns that a checksum adds up
_RECORDED = DrawRequest.__struct_fields__.index("memory")  # fields of a request that say what is drawn
_SPARE = "spare"  # a file to be overwritten


class TornFile(RunError):
    """A journal file that ends with an incomplete record; `end` is the offset after the last complete one."""

    def __init__(self, path: Path, end: int) -> None:
        super().__init__(f"{path}: no complete record at byte {end}")
        self.path = path
        self.end = end


class Record(NamedTuple):
    """One entry of a journal."""

    kind: int
    payload: bytes


class Journal:
    """Appends to the journal in `folder`, as the `Recorder` of the replay service's core.

    Args:
        number: of the first file to write.
        keep: never delete files.
    """

    def __init__(self, folder: Path, run_id: int, number: int, *, keep: bool) -> None:
        """Raise OSError if the file cannot be created."""
        self._folder = folder
        self._run_id = run_id
        self._keep = keep
        self._late: list[tuple[int, bytes]] = []  # records of draws for which there was no space
        folder.mkdir(parents=True, exist_ok=True)
        self._open(number)

    def insert(self, payload: bytes) -> None:
        """Record an insert request; raises OSError, and then has recorded nothing."""
        self._append(SEGMENT, payload)

    def draw(self, request: DrawRequest, ids: NDArray[np.int64]) -> None:
        """Record a draw. If there is no space, it is kept and written before the next record."""
        self._late.append((DRAW, msgpack.packb([*msgspec.structs.astuple(request)[:_RECORDED], ids.tobytes()])))
        with contextlib.suppress(OSError):
            self._append_late()

    def limit(self, limiter: RateLimiter) -> None:
        """Record new settings of the limiter; raises OSError."""
        self._append(LIMITER, msgpack.packb(asdict(limiter)))

    def roll(self) -> int:
        """Begin the next file and return its number; raises OSError, and then continues the present file."""
        self._append_late()
        self._write(END, b"")  # remains of an older file may follow
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
        """Release the files with lower numbers, unless all are to be kept."""
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
    """Write one record and return the offset after it. Raises OSError, and then leaves the file's end at `at`."""
    header = _HEADER.pack(_checksum(kind, number, place, payload), kind, place, len(payload))
    try:
        written = os.pwritev(file, [header, payload], at)
        if written < len(header) + len(payload):  # the disk is probably full: writing the rest raises
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
    """Delete every file of a journal; raises OSError."""
    for number in journal_files(folder):
        _path(folder, number).unlink()


def read_file(folder: Path, number: int, run_id: int) -> Iterator[Record]:
    """Yield the records of one file, except the one that names it.

    Raises:
        UsageError: the file has another format.
        TornFile: an incomplete record follows those yielded.
        RunError: it cannot be read, or belongs to another run.
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
    """The id of the run to which a file belongs; None if the file's first record is incomplete."""
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
    """Read a recorded draw: the request, and the ids of the transitions drawn, int64 [batch]."""
    *request, ids = msgpack.unpackb(payload)
    return DrawRequest(*request), np.frombuffer(ids, np.int64)


def read_limiter(payload: bytes) -> RateLimiter:
    """Read recorded settings of the limiter."""
    return RateLimiter.from_table(msgpack.unpackb(payload))


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:08}.log"


def _checksum(kind: int, number: int, place: int, payload: bytes) -> int:
    """CRC-32 over sums of the payload's 64-bit columns, in a tenth of the time of CRC-32 over the whole payload.

    number, place: of the file, and of the record in it, so that remains of an older file do not pass for a record.
    """
    whole = len(payload) // (8 * _LANES) * 8 * _LANES
    lanes = np.frombuffer(payload, np.uint64, whole // 8).reshape(-1, _LANES).sum(axis=0, dtype=np.uint64)
    return zlib.crc32(
        payload[whole:], zlib.crc32(lanes.tobytes(), zlib.crc32(struct.pack("<IQQ", kind, number, place)))
    )
