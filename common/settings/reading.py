"""Turns tables into dataclasses whose field types say what is allowed: msgspec checks them, as it checks messages."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from coop.common.errors import ALSO_CALLED, UsageError, closest, refusal
from coop.common.numbers import whole_number

T = TypeVar("T")
MAX_DEPTH = 32  # of tables and lists in each other
_PROBLEM = re.compile(r"^(?P<problem>.*?)(?: - at .*`\$(?P<path>[^`]*)`)?$", re.DOTALL)  # msgspec's error texts
_WORDS = {"`": "", "object": "table", "array": "list", "null": "None", "<= 1.7976931348623157e+308": "that is finite"}


@dataclass(frozen=True)
class Read:
    """Marks the type of a field: its values are read by a function, which raises ValueError with what is allowed."""

    function: Callable[[Any], Any]


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a text in TOML; raises UsageError for another text, or one that nests or counts without end."""
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # it raises more than its own errors
        raise UsageError(str(error)) from error
    level: list[Any] = [tables]
    for _ in range(MAX_DEPTH):
        values = (value for each in level for value in (each.values() if isinstance(each, dict) else each))
        level = [value for value in values if isinstance(value, dict | list)]
        if not level:
            return tables
    raise UsageError(f"nests more than {MAX_DEPTH} tables and lists")


def checked(kind: type[T], tables: Any, prefix: str = "") -> T:  # noqa: ANN401 (of a file, or of a user's code)
    """An instance of nested dataclasses from nested tables; prefix: of the fields' names in errors.

    Raises:
        UsageError: an unknown field or a value that is not allowed, with the field, the value and what is allowed.
    """
    tables = _read(kind, with_numbers(kind, tables), prefix, kind)
    try:
        return msgspec.convert(tables, kind, strict=False)
    except msgspec.ValidationError as error:
        raise UsageError(_explained(error, kind, tables, prefix)) from error


def with_numbers(kind: Any, value: Any) -> Any:  # noqa: ANN401 (any types, any value)
    """Nested tables in which whole numbers are ints and numpy's are Python's, for what is derived from them.

    kind: a dataclass, whose fields say where whole numbers stand. What is none there is left as it is.
    """
    if isinstance(value, np.generic):
        value = value.item()
    base = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if is_dataclass(base) and isinstance(value, Mapping):
        known = fields_of(base)  # type: ignore[arg-type] # a class
        return {name: with_numbers(known.get(name, object), each) for name, each in value.items()}
    if get_origin(base) is tuple and isinstance(value, list | tuple):
        return [with_numbers(get_args(base)[0], each) for each in value]
    if (base is int or int in get_args(base)) and isinstance(value, str | float):
        with suppress(ValueError):
            return whole_number(str(value))
    return value


@cache
def fields_of(kind: type[Any]) -> dict[str, Any]:
    """The fields that tables may have, with their types."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name] for name in kind.__dataclass_fields__ if name != "method_settings"}


def _read(kind: Any, value: Any, place: str, whole: Any) -> Any:  # noqa: ANN401 (any types, any value)
    base, *marks = get_args(kind) if get_origin(kind) is Annotated else (kind,)
    for mark in marks:
        if isinstance(mark, Read):
            try:
                value = mark.function(value)
            except ValueError as error:
                raise UsageError(f"{place} = {_shown(value)}: {error}") from error
    if is_dataclass(base) and isinstance(value, Mapping):
        place = place if not place or place.endswith(".") else f"{place}."
        known = fields_of(base)  # type: ignore[arg-type] # a class
        for name, each in value.items():
            if name not in known:
                near = _elsewhere(whole).get(ALSO_CALLED.get(str(name), str(name))) or closest(str(name), known)
                if near is not None and near == name and "." in near:  # the dotted name that flags have
                    table, _, last = near.partition(".")
                    near = f'{table}={{"{last}": ...}}'
                problem = refusal("no such field", near, f"allowed: {', '.join(known)}")
                raise UsageError(f"{place}{name} = {_shown(each)}: {problem}")
        return {name: _read(known[name], each, f"{place}{name}", whole) for name, each in value.items()}
    if get_origin(base) is tuple and not isinstance(value, list | tuple):
        raise UsageError(f"{place} = {value!r}: must be a list, such as [64, 64]")
    if get_origin(base) is tuple:
        return [_read(get_args(base)[0], each, f"{place}[{n}]", whole) for n, each in enumerate(value)]
    return value


def _shown(value: object) -> str:
    try:
        return repr(value)
    except RecursionError:
        return type(value).__name__


@cache
def _elsewhere(kind: Any) -> dict[str, str]:  # noqa: ANN401 (any dataclass)
    """The dotted names of nested dataclasses' fields, by themselves and by their last part."""
    found: dict[str, str] = {}
    for name, each in fields_of(kind).items():
        base: Any = get_args(each)[0] if get_origin(each) is Annotated else each
        inner = [f"{name}.{path}" for path in _elsewhere(base).values()] if is_dataclass(base) else [name]  # type: ignore[arg-type]
        for path in inner:
            found[path] = path
            found.setdefault(path.rpartition(".")[2], path)
    return found


def _explained(error: msgspec.ValidationError, kind: Any, tables: Any, prefix: str) -> str:  # noqa: ANN401
    """The field, its value and what is allowed, from a text such as "Expected `int` >= 1 - at `$.replay.capacity`"."""
    found = _PROBLEM.match(str(error))
    assert found is not None
    path, problem = (found["path"] or "").removeprefix("."), found["problem"]
    for part in re.findall(r"[^.\[\]]+", path):
        if is_dataclass(kind) and isinstance(tables, Mapping):
            kind, tables = fields_of(kind)[part], tables[part]  # type: ignore[arg-type] # a class
        elif isinstance(tables, list) and part.isdigit():
            tables = tables[int(part)]
    if get_origin(kind) is Literal:
        problem = f"allowed: {', '.join(map(repr, get_args(kind)))}"
    for word, ours in _WORDS.items():
        problem = problem.replace(word, ours)
    return f"{f'{prefix}{path}'.rstrip('.')} = {tables!r}: {problem[0].lower()}{problem[1:]}"
