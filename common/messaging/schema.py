"""Checks of a decoded message against what its kind may hold: known keys, types, bounds, dtypes and shapes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from reprlib import repr as shown
from typing import Any, Protocol

from common.errors import BadMessage
from common.messaging.wire import Message


class Rule(Protocol):
    """What one field may hold."""

    def problem(self, value: Any) -> str | None:  # noqa: ANN401 (whatever the peer sent)
        """None if the value is allowed, else what is wrong with it."""


@dataclass(frozen=True, slots=True)
class Int:
    """An integer of [low, high]."""

    low: int = 0
    high: int = 2**63 - 1

    def problem(self, value: Any) -> str | None:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is int and self.low <= value <= self.high:
            return None
        return f"{shown(value)}; an integer from {self.low} to {self.high}"


@dataclass(frozen=True, slots=True)
class Real:
    """A finite number."""

    def problem(self, value: Any) -> str | None:  # noqa: ANN401
        """See `Rule`."""
        if type(value) in (int, float) and math.isfinite(value):
            return None
        return f"{shown(value)}; a finite number"


@dataclass(frozen=True, slots=True)
class Flag:
    """True or false."""

    def problem(self, value: Any) -> str | None:  # noqa: ANN401
        """See `Rule`."""
        return None if type(value) is bool else f"{shown(value)}; true or false"


@dataclass(frozen=True, slots=True)
class Text:
    """A string of at most `longest` characters."""

    longest: int = 1024

    def problem(self, value: Any) -> str | None:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is str and len(value) <= self.longest:
            return None
        return f"a string of at most {self.longest} characters"


@dataclass(frozen=True, slots=True)
class ListOf:
    """A list of at most `longest` items that all follow one rule."""

    rule: Rule
    longest: int = 256

    def problem(self, value: Any) -> str | None:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is not list or len(value) > self.longest:
            return f"a list of at most {self.longest} items"
        return next((text for item in value if (text := self.rule.problem(item))), None)


@dataclass(frozen=True, slots=True)
class Row:
    """A list with one rule for each place."""

    rules: tuple[Rule, ...]

    def problem(self, value: Any) -> str | None:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is not list or len(value) != len(self.rules):
            return f"a list of {len(self.rules)} values"
        return next((text for rule, item in zip(self.rules, value, strict=True) if (text := rule.problem(item))), None)


@dataclass(frozen=True, slots=True)
class Optional:
    """What another rule allows, or nothing."""

    rule: Rule

    def problem(self, value: Any) -> str | None:  # noqa: ANN401
        """See `Rule`."""
        return None if value is None else self.rule.problem(value)


@dataclass(frozen=True, slots=True)
class Table:
    """A mapping of names to plain values whose meaning its reader checks."""

    def problem(self, value: Any) -> str | None:  # noqa: ANN401
        """See `Rule`."""
        return None if type(value) is dict else "a table"


@dataclass(frozen=True, slots=True)
class Schema:
    """What one kind of message holds.

    fields: rule of each field; all are required and no other is allowed.
    arrays: name -> (dtype, shape); a word in a shape stands for any length, the same one everywhere in the message.
    optional: names of arrays that may be missing.
    """

    kind: str
    fields: Mapping[str, Rule]
    arrays: Mapping[str, tuple[str, tuple[int | str, ...]]]
    optional: frozenset[str] = frozenset()

    def check(self, message: Message) -> dict[str, int]:
        """Return the lengths that the shape words stand for.

        Raises:
            BadMessage: the first thing that does not fit; names the field.
        """
        if message.kind != self.kind:
            raise BadMessage("kind", f"{message.kind!r} instead of {self.kind!r}")
        if message.fields.keys() != self.fields.keys():
            raise BadMessage("fields", f"{_difference(message.fields, self.fields)}")
        for name, rule in self.fields.items():
            if problem := rule.problem(message.fields[name]):
                raise BadMessage(f"fields.{name}", problem)
        if message.arrays.keys() | self.optional != self.arrays.keys():
            raise BadMessage("arrays", f"{_difference(message.arrays, self.arrays)}")
        lengths: dict[str, int] = {}
        for name, array in message.arrays.items():
            dtype, shape = self.arrays[name]
            if array.dtype != dtype:
                raise BadMessage(f"arrays.{name}", f"dtype {array.dtype.name} instead of {dtype}")
            expected = tuple(
                lengths.setdefault(n, have) if isinstance(n, str) else n
                for n, have in zip(shape, array.shape, strict=False)
            )
            if array.shape != expected or len(shape) != array.ndim:
                raise BadMessage(f"arrays.{name}", f"shape {list(array.shape)} instead of {list(shape)}")
        return lengths


def _difference(have: Mapping[str, Any], want: Mapping[str, Any]) -> str:
    missing, unknown = sorted(want.keys() - have.keys()), sorted(have.keys() - want.keys())
    return "; ".join(
        f"{word} {', '.join(names)}" for word, names in (("missing", missing), ("unknown", unknown)) if names
    )
