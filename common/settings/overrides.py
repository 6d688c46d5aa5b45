"""Settings of a preset or file for single methods, and how a resolved config keeps those of other methods."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, fields
from functools import reduce
from typing import Any

from coop.common.errors import UsageError
from coop.common.settings.config import RunConfig
from coop.common.settings.methods import METHODS, table_of
from coop.common.settings.reading import MAX_DEPTH

_FieldPath = tuple[str, ...]  # in nested tables: ("learner", "optimizer")
_FIELDS = {field.name for field in fields(RunConfig)}


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`, table by table.

    Raises:
        UsageError: a value stands where a table is expected.
    """
    result = dict(base)
    for key, value in over.items():
        if isinstance(result.get(key), Mapping):
            if not isinstance(value, Mapping):
                raise UsageError(f"{key} = {value!r}: must be a table")
            result[key] = merged(result[key], value)
        else:
            result[key] = value
    return result


def leaves(tables: Mapping[str, Any], at: _FieldPath = ()) -> Iterator[tuple[_FieldPath, Any]]:
    """Yield the values of nested tables with their paths; raises UsageError for tables that nest without end."""
    if len(at) > MAX_DEPTH:
        raise UsageError(f"{'.'.join(at[:2])}: nests more than {MAX_DEPTH} tables")
    for key, value in tables.items():
        if isinstance(value, Mapping):
            yield from leaves(value, (*at, str(key)))
        else:
            yield (*at, str(key)), value


def nested(path: _FieldPath, value: Any) -> dict[str, Any]:  # noqa: ANN401 (a value of any field)
    """Nested tables with a single value at `path`."""
    for key in reversed(path):
        value = {key: value}
    return dict(value)


def of_method(tables: Mapping[str, Any], method: str | None) -> dict[str, Any]:
    """The tables of one method (None: the one that they name): `[methods.NAME]` overrides the rest.

    The settings in which other methods differ stay in `methods`, so that a resolved config still has them; so do the
    tables of their own settings.

    Raises:
        UsageError: `methods` does not hold tables.
    """
    overrides = tables.get("methods", {})
    if not isinstance(overrides, Mapping) or not all(isinstance(over, Mapping) for over in overrides.values()):
        raise UsageError("methods: must hold one table for each method, [methods.NAME]")
    if unknown := [name for name in overrides if not METHODS.knows(name)]:
        raise UsageError(f"methods.{min(unknown)}: no such method; allowed: {', '.join(METHODS.names())}")
    named = [name for name in (*overrides, tables.get("method"), method) if isinstance(name, str) and ":" in name]
    names = tuple(dict.fromkeys((*METHODS.names(), *named)))
    own = {name: table for name in names if (table := _own_table(name, tables, overrides))}
    overrides = {name: _without(over, own.get(name, {})) for name, over in overrides.items()}
    stated = _without(tables, {"methods", *map(table_of, own)})
    chosen = stated.get("method", RunConfig.method) if method is None else method
    known = chosen if isinstance(chosen, str) else ""  # what is no name is refused with the other fields
    mine = merged({**stated, "method": chosen}, overrides.get(known, {}))
    touched = {path for over in overrides.values() for path, _ in leaves(over)}
    others = {name: table for name, table in own.items() if name != chosen}
    for other in names:
        theirs = merged(stated, overrides.get(other, {}))
        for path in sorted(touched) if other != chosen else ():
            if (value := _value(theirs, path)) != _value(mine, path):
                others = merged(others, nested((other, *path), "None" if value is None else value))
    return {**mine, **own.get(known, {}), "methods": others}


def _own_table(method: str, tables: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """{table: settings} of a method's own settings; empty if none are given."""
    name = table_of(method)
    given = ({name: each[name]} for each in (tables, overrides.get(method, {})) if name in each)
    return reduce(merged, given, {}) if name not in _FIELDS else {}


def _without(tables: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    return {name: value for name, value in tables.items() if name not in names}


def _value(tables: Any, path: _FieldPath) -> Any:  # noqa: ANN401
    """The value at `path`, or its default if there is none."""
    default: Any = asdict(RunConfig())
    for key in path:
        tables = tables.get(key) if isinstance(tables, Mapping) else None
        default = default.get(key) if isinstance(default, Mapping) else None
    return default if tables is None else tables
