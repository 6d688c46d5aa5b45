"""The checksum of a whole Parquet file, in its metadata; its pages have checksums of their own, but not their headers.

It is checked before a library reads the file: a changed bit of what describes the columns can end the process.
"""

from __future__ import annotations

import mmap
import re
import zlib
from pathlib import Path

SEAL, UNSEALED = "coop", "crc32 of the rest:00000000"  # an entry of the metadata; with its digits the checksum
SIZE, UNSIZED = (
    "coop bytes",
    "size of the whole:000000000000000000",
)  # another; who changes rows may copy both
_SEALED = re.compile(rb"crc32 of the rest:[0-9a-f]{8}")
_SIZED = re.compile(rb"size of the whole:[0-9]{18}")


def sealed(content: bytes) -> bytes:
    """Put the checksum of a Parquet file whose metadata hold UNSEALED in its place."""
    start = content.rindex(UNSEALED.encode())
    return content[:start] + _seal_of(content, start) + content[start + len(UNSEALED) :]


def seal_file(path: Path) -> None:
    """As `sealed`, of a file on the disk whose metadata hold UNSIZED too, which gets its size; raises OSError."""
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
        start = content.rfind(UNSIZED.encode())
        content[start : start + len(UNSIZED)] = f"{UNSIZED[:-18]}{len(content):018}".encode()
        start = content.rfind(UNSEALED.encode())
        content[start : start + len(UNSEALED)] = _seal_of(content, start)


def has_seal(content: bytes | mmap.mmap) -> bool | None:
    """Whether a file is what was sealed; None if it has no seal, or is another file that one has been copied into."""
    start = content.rfind(UNSEALED[:-8].encode())
    if start < 0 or not (found := _SEALED.match(content, start)):
        return None
    place = content.rfind(UNSIZED[:-18].encode())
    if place >= 0 and (sized := _SIZED.match(content, place)) and int(sized[0][-18:]) != len(content):
        return None
    return found[0] == _seal_of(content, start)


def _seal_of(content: bytes | mmap.mmap, start: int) -> bytes:
    """The seal at `start` of a file: of all bytes, with zeros as its own digits."""
    with memoryview(content) as view:
        before = zlib.crc32(UNSEALED.encode(), zlib.crc32(view[:start]))
        return f"{UNSEALED[:-8]}{zlib.crc32(view[start + len(UNSEALED) :], before):08x}".encode()
