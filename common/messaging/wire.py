"""The wire format: `[u32 magic][u32 header length][msgpack header][raw little-endian arrays, 64-byte aligned]`.

Decoding views the arrays in place and never allocates a size that the sender states: it checks every length against the
bytes that arrived. `common.messaging.messages` gives the fields of each kind of message their meaning.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Set
from dataclasses import dataclass
from reprlib import repr as shown
from typing import Any, Protocol

import msgpack
import msgspec
import numpy as np

from common.bounds import MAX_PAYLOAD
from common.errors import BadMessage
from common.types import Array

PROTOCOL = 6
ON_DISK = frozenset({1, 2, 3, 4, 5, 6})  # protocols whose segments and batches in journals and snapshots can be read
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
_pack = msgspec.msgpack.Encoder().encode


@dataclass(frozen=True, slots=True)
class Message:
    """One decoded message; `arrays` are read-only views of `payload`, the bytes received."""

    kind: str
    run: str
    fields: Mapping[str, Any]
    arrays: Mapping[str, Array]
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
    """Build one message; each array is copied once, into its place.

    into: an earlier message whose memory is reused, because it is in the processor's caches.
    """
    arrays = arrays or {}
    table: list[tuple[str, str, tuple[int, ...], int]] = []
    size = 0
    for name, array in arrays.items():
        offset = _aligned(size)
        table.append((name, _NAMES[array.dtype], array.shape, offset))
        size = offset + array.nbytes
    header = _pack({"protocol": PROTOCOL, "kind": kind, "run": run, "fields": fields, "arrays": table})
    head = _PREFIX.pack(MAGIC, len(header)) + header
    start = _aligned(len(head))
    payload = _sized(into, start + size)
    payload[:start] = head.ljust(start, b"\0")
    whole = memoryview(payload)
    end = start
    for (_, dtype, shape, offset), array in zip(table, arrays.values(), strict=True):
        begin = start + offset
        whole[end:begin] = bytes(begin - end)
        end = begin + array.nbytes
        if not array.nbytes:
            continue
        if isinstance(array, np.ndarray):
            whole[begin:end] = np.ascontiguousarray(array, DTYPES[dtype]).data.cast("B")
        else:
            array.copy_to(np.ndarray(shape, DTYPES[dtype], payload, begin))
    return payload


def _sized(memory: bytearray | None, size: int) -> bytearray:
    if memory is None:
        return bytearray(size)
    if len(memory) > size:
        del memory[size:]
    else:
        memory.extend(bytes(size - len(memory)))
    return memory


def decode(payload: bytes, protocols: frozenset[int] | None = None) -> Message:
    """Decode a message of this protocol, or of one of `protocols`, without copying.

    Raises:
        BadMessage: the bytes are not a whole, well-formed message of this protocol; names the field.
    """
    header, start = _header(payload, protocols or {PROTOCOL})
    arrays: dict[str, Array] = {}
    for entry in header["arrays"]:
        name, array = _view(payload, start, entry)
        if name in arrays:
            raise BadMessage(f"arrays.{name}", "appears twice")
        arrays[name] = array
    return Message(header["kind"], header["run"], header["fields"], arrays, payload)


def _aligned(offset: int) -> int:
    return -(-offset // ALIGNMENT) * ALIGNMENT


def _header(payload: bytes, protocols: Set[int]) -> tuple[dict[str, Any], int]:
    if not _PREFIX.size <= len(payload) <= MAX_PAYLOAD:
        raise BadMessage("payload", f"{len(payload)} bytes; allowed: {_PREFIX.size} to {MAX_PAYLOAD}")
    magic, length = _PREFIX.unpack_from(payload)
    if magic != MAGIC:
        raise BadMessage("magic", f"{magic:#x} instead of {MAGIC:#x}")
    if length > min(MAX_HEADER, len(payload) - _PREFIX.size):
        raise BadMessage("header length", f"{length} bytes in a payload of {len(payload)}; at most {MAX_HEADER}")
    try:
        header = msgpack.unpackb(payload[_PREFIX.size : _PREFIX.size + length], raw=False, strict_map_key=True)
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise BadMessage("header", f"not msgpack ({type(error).__name__})") from error
    if not isinstance(header, dict) or header.keys() != {"protocol", "kind", "run", "fields", "arrays"}:
        raise BadMessage("header", "must hold exactly protocol, kind, run, fields, arrays")
    if type(header["protocol"]) is not int or header["protocol"] not in protocols:
        raise BadMessage("protocol", f"version {shown(header['protocol'])}; this process speaks {PROTOCOL}")
    for name, kind in (("kind", str), ("run", str), ("fields", dict), ("arrays", list)):
        if not isinstance(header[name], kind):
            raise BadMessage(name, f"must be a {kind.__name__}")
    if not all(isinstance(name, str) for name in header["fields"]):
        raise BadMessage("fields", "names must be strings")
    if len(header["arrays"]) > MAX_ARRAYS:
        raise BadMessage("arrays", f"{len(header['arrays'])} of them; at most {MAX_ARRAYS}")
    return header, _aligned(_PREFIX.size + length)


def _view(payload: bytes, start: int, entry: Any) -> tuple[str, Array]:  # noqa: ANN401 (whatever the peer sent)
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
    if size and start + offset + size * kind.itemsize > len(payload):
        raise BadMessage(
            f"arrays.{name}", f"{dtype}{shape} at {offset} reaches beyond the payload's {len(payload)} bytes"
        )
    if not size:
        return name, np.empty(shape, kind)
    return name, np.ndarray(shape, kind, payload, start + offset)


def _is_length(value: Any) -> bool:  # noqa: ANN401 (whatever the peer sent)
    return type(value) is int and 0 <= value <= MAX_PAYLOAD
