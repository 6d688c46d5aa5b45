"""The common parts of messages: a kind, fields with bounds in their types, and arrays of known dtype and shape."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Set
from reprlib import repr as shown
from typing import Any, ClassVar, Self, TypeVar

import msgspec

from coop.common.errors import BadMessage
from coop.common.messaging import wire
from coop.common.messaging.wire import ArrayTable, Message

T = TypeVar("T", bound=msgspec.Struct)
_LENGTHS = 256  # kept for each layout, by table of arrays
_PLACE = re.compile(r"^(?P<problem>.*?)(?: - at .*`\$(?P<path>[^`]*)`)?$", re.DOTALL)  # in msgspec's error texts


class Layout:
    """The arrays of a kind of message.

    arrays: by name (dtype, shape); a word in a shape stands for any length, equal throughout the message.
    names: of those, and of arrays that such messages have for other environments.
    """

    def __init__(self, arrays: Mapping[str, tuple[str, tuple[int | str, ...]]], others: Set[str] = frozenset()) -> None:
        self.arrays = arrays
        self.names = arrays.keys() | others
        self.lengths = functools.lru_cache(_LENGTHS)(self._lengths)

    def _lengths(self, table: ArrayTable) -> Mapping[str, int]:
        """The lengths that the words stand for; raises BadMessage for the first array that does not fit."""
        places = {place.name: place for place in table.places}
        if places.keys() != self.arrays.keys():
            raise BadMessage("arrays", _difference(places.keys(), self.arrays.keys()))
        lengths: dict[str, int] = {}
        for name, (dtype, shape) in self.arrays.items():
            place = places[name]
            if place.dtype != wire.DTYPES[dtype]:
                raise BadMessage(f"arrays.{name}", f"dtype {place.dtype.name} instead of {dtype}")
            expected = tuple(
                lengths.setdefault(length, have) if isinstance(length, str) else length
                for length, have in zip(shape, place.shape, strict=False)
            )
            if place.shape != expected or len(shape) != len(place.shape):
                raise BadMessage(f"arrays.{name}", f"shape {list(place.shape)} instead of {list(shape)}")
        return lengths


NO_ARRAYS = Layout({})


class Body(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A message without arrays; the wire carries all its fields."""

    kind: ClassVar[str]

    def encode(self, run: str) -> bytearray:
        """Build the message."""
        return wire.encode(self.kind, run, self)

    @classmethod
    def decode(cls, message: Message) -> Self:
        """Read it; raises BadMessage."""
        check_kind(message, cls.kind)
        NO_ARRAYS.lengths(message.table)
        return to_struct(message, cls)


def check_kind(message: Message, kind: str) -> None:
    """Raise BadMessage if a message is of another kind."""
    if message.kind != kind:
        raise BadMessage("kind", f"{shown(message.kind)} instead of {kind!r}")


def to_struct(message: Message, kind: type[T], layout: Layout = NO_ARRAYS) -> T:
    """Convert a message's fields, and its arrays checked against `layout`, into a struct; raises BadMessage."""
    fields, expected = message.fields, _names(kind)
    if layout.arrays:
        expected = expected - layout.names
    if fields.keys() != expected:
        raise BadMessage("fields", _difference(fields.keys(), expected))
    try:
        return msgspec.convert({**fields, **message.arrays} if layout.arrays else fields, kind, strict=True)
    except msgspec.ValidationError as error:
        raise bad_field(error, fields) from error


@functools.cache
def _names(kind: type[msgspec.Struct]) -> frozenset[str]:
    return frozenset(kind.__struct_fields__)


def bad_field(error: msgspec.ValidationError, fields: Mapping[str, Any]) -> BadMessage:
    """Extract the field's name from msgspec's error text, such as "Expected `int` >= 0 - at `$.episodes[0][1]`"."""
    found = _PLACE.match(str(error))
    assert found is not None
    path = (found["path"] or "").partition("[")[0]
    problem = found["problem"].replace("`", "")[:200]
    value = fields.get(path[1:])
    return BadMessage(f"fields{path}", f"{shown(value)}; {problem[0].lower()}{problem[1:]}")


def _difference(have: Set[str], want: Set[str]) -> str:
    missing, unknown = sorted(want - have), sorted(have - want)
    both = (("missing", missing), ("unknown", unknown))
    return "; ".join(f"{word} {', '.join(map(_short, names))}" for word, names in both if names)


def _short(name: str) -> str:
    return name if len(name) <= wire.MAX_NAME else shown(name)
