"""The journal: every accepted segment and every draw, appended to files in order before the request is answered.

A file is a sequence of records, a header and a payload each; the first one names the run and the file. The
header has a mark to find it by, checksums of itself and of the payload, the file's and the record's numbers, and how
many transitions had been accepted after it. So a reader finds the next record behind a damaged one, and knows how many
transitions are lost.

Data handed to the operating system survive a kill -9 of this process, so records are written; what a checkpoint
continues from is flushed to the disk too. With `--replay.journal sync` all segments are before they are acknowledged,
one flush for all that wait for it. A header is written after its payload: what a kill leaves is no record. Files that
are no longer needed are overwritten: their pages are in memory already, which halves the time.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import struct
import threading
import zlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import BinaryIO, NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

from coop.common.bounds import MAX_PAYLOAD
from coop.common.errors import RunError, UsageError
from coop.common.process.files import check_guards, make_folder, sync_file, sync_folder
from coop.common.transitions import DrawRequest
from coop.records.run_ids import check_owner
from coop.replay.limiter import RateLimiter

FORMAT = 3
BEGIN, SEGMENT, DRAW, LIMITER, END = range(5)
KINDS = ("the one that names it", "a segment", "a batch", "settings of the limiter", "the last one")
BEGIN_BYTES = 64  # more than the record that names a file
ROLL_AT = 1 << 28  # bytes after which the next file begins
SEARCHED = 1 << 20  # bytes at once
LONGEST = ROLL_AT + 2 * MAX_PAYLOAD  # bytes of a file; what follows is none of this program's

_MARK = b"\xc6coop\xf0rj"
_FIELDS = struct.Struct("<IIIQQQ")  # of a Header
HEADER_BYTES = len(_MARK) + 4 + _FIELDS.size
_LANES = 1024  # 64-bit columns that a checksum adds up
_RECORDED = DrawRequest.__struct_fields__[:5]  # of a request, the numbers that say what is drawn
_SPARE = "spare"  # a file to be overwritten
_NAME = re.compile(r"[0-9]{8}\.log")


class Header(NamedTuple):
    """What precedes a payload: number of the file and place of the record in it; transitions accepted after it."""

    payload_checksum: int
    kind: int
    number: int
    place: int
    accepted: int
    length: int


class JournalRecord(NamedTuple):
    """One entry of a journal; accepted: how many transitions the run had accepted after it."""

    kind: int
    payload: bytes
    accepted: int


class Lost(NamedTuple):
    """Records of a file that can't be read; `text` names them.

    accepted: how many transitions the run had accepted after them, if the damaged record says so itself; otherwise
    the next record tells.
    """

    text: str
    accepted: int | None = None


class Journal:
    """Appends to the journal in `folder`, as the `Recorder` of the replay service's core.

    Args:
        number: of the first file to write.
        keep: never delete files.
        sync: begin files so that a `flush` is enough for their records to survive the machine.
        accepted: transitions that the run has accepted so far.
    """

    def __init__(
        self, folder: Path, run_id: int, number: int, *, keep: bool, sync: bool = False, accepted: int = 0
    ) -> None:
        """Raise OSError if the file cannot be created."""
        self._folder = folder
        self._run_id = run_id
        self._keep = keep
        self._sync = sync
        self._accepted = accepted
        self._late: list[tuple[int, bytes]] = []  # records of draws for which there was no space
        self._failed: OSError | None = None  # the first flush that has failed, if records must survive the machine
        self._file = self._number = self._records = self._end = self._flushed = 0
        make_folder(folder)
        self._open(number, flush=True)

    def insert(self, payload: bytes, transitions: int) -> None:
        """Record an insert request; raises OSError, and then has recorded nothing."""
        self._append(SEGMENT, payload, transitions)

    def draw(self, request: DrawRequest, ids: NDArray[np.int64]) -> None:
        """Record a draw. If there is no space, it is kept and written before the next record."""
        numbers = [getattr(request, name) for name in _RECORDED]
        arrays = [array.tobytes() for array in (request.ids, request.priorities, ids)]
        self._late.append((DRAW, msgpack.packb([numbers, *arrays])))
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
            self._open(self._number + 1, flush=self._sync)
        except OSError:
            self._end -= HEADER_BYTES
            self._records -= 1
            raise
        os.close(before)
        return self._number

    def flush(self, lock: threading.Condition) -> None:
        """Flush what has been recorded to the disk; raises OSError: what was not flushed before may be lost.

        lock: guards this journal; it is not held meanwhile.
        """
        with lock:
            self._check()
            file, number, end = os.dup(self._file), self._number, self._end  # which may be rolled meanwhile
        try:
            os.fdatasync(file)
        except OSError as error:
            self._failed = error
        finally:
            os.close(file)
        with lock:
            self._check()
            if number == self._number:
                self._flushed = max(self._flushed, end)

    def _check(self) -> None:
        """Raise OSError if a flush has failed.

        What it was to write may be lost, and can be read all the same, until the machine ends. So it is cut off, and
        nothing follows: a process that goes on from this journal must find no more than the disk holds.
        """
        if self._failed is not None:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._flushed)
            raise OSError(self._failed.errno, self._failed.strerror)

    def close(self) -> None:
        """End the journal as one that was not killed; raises OSError."""
        self._append_late()
        self._write(END, b"")
        os.fsync(self._file)
        os.close(self._file)

    def sync(self, number: int) -> None:
        """Flush what the journal held when file `number` was begun to the disk; raises OSError."""
        try:
            for each in (number - 1, number):
                with contextlib.suppress(FileNotFoundError):
                    sync_file(_path(self._folder, each))
            sync_folder(self._folder)
        except OSError as error:
            self._failed = error if self._sync else None
            raise

    def drop(self, before: int) -> None:
        """Release the files with lower numbers, unless all are to be kept."""
        for number in () if self._keep else journal_files(self._folder):
            if number < before:
                _path(self._folder, number).replace(self._folder / _SPARE)

    def _open(self, number: int, *, flush: bool) -> None:
        """Begin a file, flushed if asked for; raises OSError, and then continues the present one."""
        path = _path(self._folder, number)
        payload = msgpack.packb([FORMAT, self._run_id, number])
        with contextlib.suppress(FileNotFoundError):
            (self._folder / _SPARE).rename(path)
        file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
        try:
            end = _write(file, 0, Header(_checksum(payload), BEGIN, number, 0, self._accepted, len(payload)), payload)
            if flush:
                self.sync(number)
                self._flushed = end
        except OSError:
            os.close(file)
            with contextlib.suppress(OSError):
                path.unlink()
            raise
        self._file, self._number, self._records, self._end = file, number, 1, end

    def _append(self, kind: int, payload: bytes, transitions: int = 0) -> None:
        if self._end > ROLL_AT:
            self.roll()
        self._append_late()
        self._write(kind, payload, transitions)

    def _append_late(self) -> None:
        while self._late:
            self._write(*self._late[0])
            del self._late[0]

    def _write(self, kind: int, payload: bytes, transitions: int = 0) -> None:
        check_guards()
        self._check()
        accepted = self._accepted + transitions
        header = Header(_checksum(payload), kind, self._number, self._records, accepted, len(payload))
        try:
            self._end = _write(self._file, self._end, header, payload)
        except OSError:
            if not (self._folder / _SPARE).exists():
                raise
            (self._folder / _SPARE).unlink()
            self._end = _write(self._file, self._end, header, payload)
        self._records += 1
        self._accepted = accepted


def _write(file: int, at: int, header: Header, payload: bytes) -> int:
    """Write one record, the header last; return the offset after it. Raises OSError, and then nothing follows `at`."""
    try:
        for data, place in ((payload, at + HEADER_BYTES), (_packed(header), at)):
            written = os.pwrite(file, data, place)
            if written < len(data):  # the disk is probably full: writing the rest raises
                written += os.pwrite(file, data[written:], place + written)
            if written < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError:
        with contextlib.suppress(OSError):
            os.ftruncate(file, at)
        raise
    return at + HEADER_BYTES + len(payload)


def journal_files(folder: Path) -> list[int]:
    """Numbers of a journal's files, in ascending order; other files there are the user's."""
    try:
        return sorted(int(path.stem) for path in folder.iterdir() if _NAME.fullmatch(path.name))
    except OSError:
        return []


def journal_names(folder: Path) -> list[str]:
    """Paths of the files of the journal in `folder`/journal, relative to `folder`."""
    return [str(_path(Path("journal"), number)) for number in journal_files(folder / "journal")]


def read_file(folder: Path, number: int, run_id: int) -> Iterator[JournalRecord | Lost]:
    """Yield the records of one file, those that begin and end it included, and what is lost between and behind them.

    The file of a process that was killed ends behind its last whole record, which is no loss.

    Raises:
        UsageError: the file has another format.
        RunError: it cannot be read, or belongs to another run.
    """
    path = _path(folder, number)
    try:
        with path.open("rb") as file:
            size = min(os.fstat(file.fileno()).st_size, LONGEST)
            at = expected = 0
            while True:
                header = _read_header(file, at, number)
                if header is None or header.place < expected:
                    found = _find_header(file, at, number, expected)
                    if found is None:
                        if not expected or _is_damaged(file, at):
                            yield Lost(f"{path}: record {expected} at byte {at:,} can't be read, nor what follows it")
                        return
                    at, header = found
                if header.place > expected:
                    yield Lost(f"{path}: {_places(expected, header.place)} before byte {at:,} can't be read")
                fits = header.length <= MAX_PAYLOAD and at + HEADER_BYTES + header.length <= size
                payload = file.read(header.length) if fits else b""
                if len(payload) == header.length and _checksum(payload) == header.payload_checksum:
                    if header.kind == BEGIN:
                        _check_begin(path, payload, run_id)
                    yield JournalRecord(header.kind, payload, header.accepted)
                    if header.kind == END:
                        return
                    at += HEADER_BYTES + header.length
                else:
                    kind = KINDS[header.kind] if header.kind < len(KINDS) else "of an unknown kind"
                    yield Lost(f"{path}: record {header.place} at byte {at:,}, {kind}, is damaged", header.accepted)
                    at += HEADER_BYTES
                expected = header.place + 1
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error


def _places(first: int, after: int) -> str:
    return f"record {first}" if after == first + 1 else f"records {first} to {after - 1}"


def _packed(header: Header) -> bytes:
    fields = _FIELDS.pack(*header)
    return _MARK + zlib.crc32(fields).to_bytes(4, "little") + fields


def _unpacked(packed: bytes) -> Header | None:
    """The header in `packed`, if its checksum is right; the mark is only to find it by."""
    if len(packed) < HEADER_BYTES:
        return None
    header = Header(*_FIELDS.unpack(packed[HEADER_BYTES - _FIELDS.size :]))
    return header if _packed(header)[len(_MARK) :] == packed[len(_MARK) :] else None


def _read_header(file: BinaryIO, at: int, number: int) -> Header | None:
    """The header at byte `at`, if it is one of file `number`, and not the remains of an older file."""
    file.seek(at)
    header = _unpacked(file.read(HEADER_BYTES))
    return header if header is not None and header.number == number else None


def _is_damaged(file: BinaryIO, at: int) -> bool:
    """True if a header at byte `at` has been damaged; False for what a kill leaves, or remains of an older file."""
    file.seek(at)
    packed = file.read(HEADER_BYTES)
    return len(packed) == HEADER_BYTES and packed.startswith(_MARK) and _unpacked(packed) is None


def _find_header(file: BinaryIO, start: int, number: int, expected: int) -> tuple[int, Header] | None:
    """Offset and header of the next record of the file from byte `start` on, whose place is at least `expected`.

    The file is left behind the header.
    """
    while True:
        file.seek(start)
        piece = file.read(SEARCHED)
        at = piece.find(_MARK)
        while at >= 0:
            header = _read_header(file, start + at, number)
            if header is not None and header.place >= expected:
                return start + at, header
            at = piece.find(_MARK, at + 1)
        if len(piece) < SEARCHED or start > LONGEST:
            return None
        start += SEARCHED - len(_MARK) + 1


def read_owner(folder: Path, number: int) -> int | None:
    """The id of the run to which a file belongs; None if the file's first record can't be read."""
    try:
        with _path(folder, number).open("rb") as file:
            header = _read_header(file, 0, number)
            payload = b"" if header is None else file.read(min(header.length, BEGIN_BYTES))
    except OSError as error:
        raise RunError(f"{_path(folder, number)}: {error.strerror or error}") from error
    if header is None or header.kind != BEGIN or _checksum(payload) != header.payload_checksum:
        return None
    return int(msgpack.unpackb(payload)[1])


def _check_begin(path: Path, payload: bytes, run_id: int) -> None:
    version, found, _ = msgpack.unpackb(payload)
    if version != FORMAT:
        raise UsageError(f"{path}: format {version} of the journal, this program reads {FORMAT}")
    check_owner(path, found, run_id)


def read_draw(payload: bytes) -> tuple[DrawRequest, NDArray[np.int64]]:
    """Read a recorded draw: the request, and the ids of the transitions drawn, int64 [batch]."""
    numbers, prioritised, priorities, ids = msgpack.unpackb(payload)
    fields = dict(zip(_RECORDED, numbers, strict=True))
    fields |= {"ids": np.frombuffer(prioritised, np.int64), "priorities": np.frombuffer(priorities, np.float32)}
    return DrawRequest(**fields), np.frombuffer(ids, np.int64)


def read_limiter(payload: bytes) -> RateLimiter:
    """Read recorded settings of the limiter."""
    return RateLimiter.from_table(msgpack.unpackb(payload))


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:08}.log"


def _checksum(payload: bytes) -> int:
    """CRC-32 over sums of the payload's 64-bit columns, in a tenth of the time of CRC-32 over the whole payload."""
    whole = len(payload) // (8 * _LANES) * 8 * _LANES
    lanes = np.frombuffer(payload, np.uint64, whole // 8).reshape(-1, _LANES).sum(axis=0, dtype=np.uint64)
    return zlib.crc32(payload[whole:], zlib.crc32(lanes.tobytes()))
