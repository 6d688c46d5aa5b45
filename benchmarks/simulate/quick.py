"""What the product does again and again with the same outcome is done once here: a seed takes less time for it."""

from __future__ import annotations

import ast
import pkgutil
from collections.abc import Callable
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from coop.common.messaging import wire
from coop.common.messaging.messages.body import Body
from coop.common.types import Array
from coop.replay.persistence import storage

_KEPT = 4096
_HEADER = 10  # bytes before the header of a .npy file, of version 1, whose last two are its length

_owner = lru_cache(_KEPT)(pkgutil.resolve_name)
_joined = lru_cache(_KEPT)(PurePath.__truediv__)
_decoded = lru_cache(_KEPT)(wire.decode)  # nobody changes messages, whose arrays can't be
_header_of = lru_cache(_KEPT)(storage._header)
_encode = Body.encode


def replace(stack: ExitStack, place: str, what: object) -> None:
    """Put something in an attribute's place, "module.name" or "module.Class.name", until the stack ends."""
    path, _, name = place.rpartition(".")
    owner = _owner(path)
    stack.callback(setattr, owner, name, vars(owner)[name])
    setattr(owner, name, what)


def install(stack: ExitStack) -> None:
    """Do so until the stack ends."""
    for place, what in _REPLACED.items():
        replace(stack, place, what)


@lru_cache(_KEPT)
def _encoded(message: Body, run: str) -> bytes:
    return bytes(_encode(message, run))


def _encode_once(message: Body, run: str) -> bytearray:
    try:
        return bytearray(_encoded(message, run))
    except TypeError:  # it holds lists
        return _encode(message, run)


@lru_cache(_KEPT)
def _layout(header: bytes) -> tuple[np.dtype[Any], tuple[int, ...]]:
    told = ast.literal_eval(header.decode())
    return np.dtype(told["descr"]), told["shape"]


def _load_array(path: Path, small: int) -> Array:
    """As `load_array`; not mapped."""
    content = path.read_bytes()
    start = _HEADER + int.from_bytes(content[_HEADER - 2 : _HEADER], "little")
    dtype, shape = _layout(content[_HEADER:start])
    return np.frombuffer(content, dtype, offset=start).reshape(shape).copy()


def _fine(*_: object) -> None:
    """All values are, and no file has links."""


_REPLACED: dict[str, Callable[..., Any]] = {
    "pathlib.PurePath.__truediv__": _joined,
    "coop.common.messaging.wire.decode": _decoded,
    "coop.common.messaging.messages.body.Body.encode": _encode_once,
    "coop.common.messaging.messages.insert.check_values": _fine,
    "coop.common.messaging.messages.insert.check_indices": _fine,
    "coop.common.messaging.messages.sample.check_values": _fine,
    "coop.common.messaging.messages.sample.check_indices": _fine,
    "coop.replay.persistence.storage.load_array": _load_array,
    "coop.replay.persistence.storage._header": _header_of,
}
