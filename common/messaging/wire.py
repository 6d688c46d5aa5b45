"""The wire format: `[u32 magic][u32 header length][msgpack header][raw little-endian arrays, 64-byte aligned]`.

Decoding views the arrays in place and never allocates a size that the sender states: it checks every length against the
bytes that arrived. `coop.common.messaging.messages` gives the fields of each kind of message their meaning.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from reprlib import repr as shown
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from coop.common.bounds import MAX_PAYLOAD
from coop.common.errors import BadMessage
from coop.common.types import Array

PROTOCOL = 10
MAGIC = 0x434F4F50  # "COOP"
ALIGNMENT = 64
MAX_HEADER = 1 << 20
MAX_ARRAYS = 64
MAX_DIMENSIONS = 8
MAX_NAME = 64
# Tables, because numpy derives a dtype and its name anew each time, which takes as long as a small message.
DTYPES = {
    name: np.dtype(name).newbyteorder("<")
    for name in ("uint8", "bool", "int32", "int64", "uint64", "float32", "float64")
}
_NAMES = {np.dtype(name): name for name in DTYPES}

_PREFIX = struct.Struct("<II")
SMALL = 1 << 13  # bytes; arrays of at most so many are joined, and written together
_TABLES = 256  # kept, of arrays: one for each number of frames that batches and segments have
_pack = msgspec.msgpack.Encoder().encode


class _Header(msgspec.Struct, forbid_unknown_fields=True):
    protocol: Any
    kind: Any
    run: Any
    fields: Any
    arrays: msgspec.Raw


_unpack_header = msgspec.msgpack.Decoder(_Header).decode
_unpack = msgspec.msgpack.Decoder().decode
# Text that is not UTF-8, a key that can't be hashed, too deep a nesting, a date out of range.
_NOT_MSGPACK = (msgspec.DecodeError, ValueError, TypeError, RecursionError, OverflowError)


class Place(NamedTuple):
    """Where one array lies: `offset` and `end` count bytes from the end of the header."""

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int
    end: int

    @property
    def nbytes(self) -> int:
        """Of the array."""
        return self.end - self.offset


@dataclass(frozen=True, slots=True, eq=False)
class ArrayTable:
    """The arrays of messages that differ in their contents only; equal tables are one object, as long as it is kept.

    size: bytes behind the header.
    """

    places: tuple[Place, ...]
    size: int


@dataclass(frozen=True, slots=True)
class Message:
    """One decoded message; `arrays` are read-only views of `payload`, the bytes received; `table` describes them."""

    kind: str
    run: str
    fields: Mapping[str, Any]
    arrays: Mapping[str, Array]
    table: ArrayTable
    payload: bytes = b""


class Source(Protocol):
    """An array stored elsewhere that `encode` copies straight into its place in a message."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the elements, one of `DTYPES`."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the decoded array."""

    @property
    def nbytes(self) -> int:
        """Bytes in the message."""

    def copy_to(self, out: Array) -> None:
        """Copy the array to `out`, contiguous memory of this dtype and shape."""


def encode(
    kind: str,
    run: str,
    fields: Mapping[str, Any] | msgspec.Struct,
    arrays: Mapping[str, Array | Source] | None = None,
    into: bytearray | None = None,
) -> bytearray:
    """Build one message; arrays of more than `SMALL` bytes are copied once, into their places.

    into: an earlier message whose memory is reused, because it is in the processor's caches.
    """
    arrays = arrays or {}
    table, stops, packed = _table_of(tuple([(name, array.dtype, array.shape) for name, array in arrays.items()]))
    header = {"protocol": PROTOCOL, "kind": kind, "run": run, "fields": fields, "arrays": packed}
    try:
        packed_header = _pack(header)
    except UnicodeEncodeError:
        fields = _escaped(msgspec.to_builtins(fields, builtin_types=(bytes,)))
        packed_header = _pack({**header, "fields": fields})
    head = _PREFIX.pack(MAGIC, len(packed_header)) + packed_header
    start = _aligned(len(head))
    payload = _sized(into, start + table.size)
    whole = memoryview(payload)
    begin, small = 0, [head.ljust(start, b"\0")]  # parts that lie side by side
    for place, stop, array in zip(table.places, stops, arrays.values(), strict=True):
        if isinstance(array, np.ndarray) and array.nbytes <= SMALL:
            small.append(array.tobytes().ljust(stop - place.offset, b"\0"))
            continue
        whole[begin : start + place.offset] = b"".join(small)
        begin = start + place.end
        if isinstance(array, np.ndarray):
            whole[start + place.offset : begin] = np.ascontiguousarray(array).data.cast("B")
        elif place.nbytes:
            array.copy_to(np.ndarray(place.shape, place.dtype, payload, start + place.offset))
        small = [bytes(stop - place.end)]
    whole[begin:] = b"".join(small)
    return payload


@lru_cache(_TABLES)
def _table_of(
    arrays: tuple[tuple[str, np.dtype[Any], tuple[int, ...]], ...],
) -> tuple[ArrayTable, tuple[int, ...], msgspec.Raw]:
    """Lay out arrays (name, dtype, shape) one after another.

    Returns (their table, where each one's padding ends, the table as a header has it).
    """
    places: list[Place] = []
    end = 0
    for name, dtype, shape in arrays:
        offset = _aligned(end)
        end = offset + math.prod(shape) * dtype.itemsize
        places.append(Place(name, DTYPES[_NAMES[dtype]], shape, offset, end))
    packed = _pack([(place.name, _NAMES[place.dtype], place.shape, place.offset) for place in places])
    stops = (*(place.offset for place in places[1:]), end)[: len(places)]
    return ArrayTable(tuple(places), end), stops, msgspec.Raw(packed)


def _escaped(value: Any) -> Any:  # noqa: ANN401 (plain values)
    """A value whose texts can be sent: names of files may hold bytes that are not UTF-8."""
    match value:
        case str():
            return value.encode(errors="backslashreplace").decode()
        case dict():
            return {key: _escaped(each) for key, each in value.items()}
        case list() | tuple():
            return [*map(_escaped, value)]
    return value


def _sized(memory: bytearray | None, size: int) -> bytearray:
    if memory is None:
        return bytearray(size)
    if len(memory) > size:
        del memory[size:]
    else:
        memory.extend(bytes(size - len(memory)))
    return memory


def decode(payload: bytes) -> Message:
    """Decode a message of this protocol without copying.

    Raises:
        BadMessage: the bytes are not a whole, well-formed message of this protocol; names the field.
    """
    header, start = _header(payload)
    table = _read_table(bytes(header.arrays))
    if table.size and start + table.size > len(payload):
        name, dtype, shape, offset, _ = next(each for each in table.places if each.nbytes and each.end == table.size)
        where = f"{dtype.name}{list(shape)} at {offset}"
        raise BadMessage(f"arrays.{name}", f"{where} reaches beyond the payload's {len(payload)} bytes")
    if len(payload) > start + _aligned(table.size):
        raise BadMessage("payload", f"{len(payload)} bytes; its arrays end after {start + table.size}")
    arrays = {
        name: np.ndarray(shape, dtype, payload, start + offset) if end > offset else np.empty(shape, dtype)
        for name, dtype, shape, offset, end in table.places
    }
    return Message(header.kind, header.run, header.fields, arrays, table, payload)


def _aligned(offset: int) -> int:
    return -(-offset // ALIGNMENT) * ALIGNMENT


def _header(payload: bytes) -> tuple[_Header, int]:
    if not _PREFIX.size <= len(payload) <= MAX_PAYLOAD:
        raise BadMessage("payload", f"{len(payload)} bytes; allowed: {_PREFIX.size} to {MAX_PAYLOAD}")
    magic, length = _PREFIX.unpack_from(payload)
    if magic != MAGIC:
        raise BadMessage("magic", f"{magic:#x} instead of {MAGIC:#x}")
    if length > min(MAX_HEADER, len(payload) - _PREFIX.size):
        raise BadMessage("header length", f"{length} bytes in a payload of {len(payload)}; at most {MAX_HEADER}")
    try:
        header = _unpack_header(payload[_PREFIX.size : _PREFIX.size + length])
    except msgspec.ValidationError as error:
        raise BadMessage("header", "must hold exactly protocol, kind, run, fields, arrays") from error
    except _NOT_MSGPACK as error:
        raise BadMessage("header", f"not msgpack ({type(error).__name__})") from error
    if type(header.protocol) is not int or header.protocol != PROTOCOL:
        raise BadMessage("protocol", f"version {shown(header.protocol)}; this process speaks {PROTOCOL}")
    for name, kind in (("kind", str), ("run", str), ("fields", dict)):
        if not isinstance(getattr(header, name), kind):
            raise BadMessage(name, f"must be a {kind.__name__}")
    if not {*map(type, header.fields)} <= {str}:
        raise BadMessage("fields", "names must be strings")
    return header, _aligned(_PREFIX.size + length)


@lru_cache(_TABLES)
def _read_table(packed: bytes) -> ArrayTable:
    """Check a table of arrays; raises BadMessage."""
    try:
        entries = _unpack(packed)
    except _NOT_MSGPACK as error:
        raise BadMessage("arrays", f"not msgpack ({type(error).__name__})") from error
    if not isinstance(entries, list):
        raise BadMessage("arrays", "must be a list")
    if len(entries) > MAX_ARRAYS:
        raise BadMessage("arrays", f"{len(entries)} of them; at most {MAX_ARRAYS}")
    places = tuple(map(_place, entries))
    names = [place.name for place in places]
    for name in names:
        if names.count(name) > 1:
            raise BadMessage(f"arrays.{name}", "appears twice")
    return ArrayTable(places, max((each.end for each in places if each.nbytes), default=0))


def _place(entry: Any) -> Place:  # noqa: ANN401 (whatever the peer sent)
    if not isinstance(entry, list) or len(entry) != 4:
        raise BadMessage("arrays", "each entry is [name, dtype, shape, offset]")
    name, dtype, shape, offset = entry
    if not isinstance(name, str) or len(name) > MAX_NAME:
        raise BadMessage("arrays", f"name {shown(name)}; a string of at most {MAX_NAME} characters")
    if not isinstance(dtype, str) or dtype not in DTYPES:
        raise BadMessage(f"arrays.{name}", f"dtype {shown(dtype)}; allowed: {', '.join(sorted(DTYPES))}")
    if not isinstance(shape, list) or len(shape) > MAX_DIMENSIONS or not all(map(_is_length, shape)):
        raise BadMessage(f"arrays.{name}", f"shape {shown(shape)}")
    size = math.prod(shape)
    if (size or math.prod(filter(None, shape))) > MAX_PAYLOAD:  # numpy refuses even an empty array of such a shape
        raise BadMessage(f"arrays.{name}", f"shape {shape}; at most {MAX_PAYLOAD} items")
    if not _is_length(offset) or offset % ALIGNMENT:
        raise BadMessage(f"arrays.{name}", f"offset {shown(offset)}; a multiple of {ALIGNMENT}")
    kind = DTYPES[dtype]
    return Place(name, kind, tuple(shape), offset, offset + size * kind.itemsize)


def _is_length(value: Any) -> bool:  # noqa: ANN401 (whatever the peer sent)
    return type(value) is int and 0 <= value <= MAX_PAYLOAD
