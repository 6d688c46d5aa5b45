"""Settings of a preset or file for single methods, and how a resolved config keeps those of other methods."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any, get_args

from common.errors import UsageError
from common.settings.config import Method, RunConfig

_FieldPath = tuple[str, ...]  # in nested tables: ("learner", "optimizer")


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
    """Yield the values of nested tables with their paths."""
    for key, value in tables.items():
        if isinstance(value, Mapping):
            yield from leaves(value, (*at, key))
        else:
            yield (*at, key), value


def nested(path: _FieldPath, value: Any) -> dict[str, Any]:  # noqa: ANN401 (a value of any field)
    """Nested tables with a single value at `path`."""
    for key in reversed(path):
        value = {key: value}
    return dict(value)


def of_method(tables: Mapping[str, Any], method: str | None) -> dict[str, Any]:
    """The tables of one method (None: the one that they name): `[methods.NAME]` overrides the rest.

    The settings in which other methods differ stay in `methods`, so that a resolved config still has them.

    Raises:
        UsageError: `methods` does not hold tables.
    """
    overrides = tables.get("methods", {})
    if not isinstance(overrides, Mapping) or not all(isinstance(over, Mapping) for over in overrides.values()):
        raise UsageError("methods: must hold one table for each method, [methods.NAME]")
    if unknown := overrides.keys() - set(get_args(Method)):
        raise UsageError(f"methods.{min(unknown)}: no such method; allowed: {', '.join(get_args(Method))}")
    stated = {name: value for name, value in tables.items() if name != "methods"}
    chosen = stated.get("method", RunConfig.method) if method is None else method
    mine = merged({**stated, "method": chosen}, overrides.get(chosen, {}))
    touched = {path for over in overrides.values() for path, _ in leaves(over)}
    others: dict[str, Any] = {}
    for other in get_args(Method):
        theirs = merged(stated, overrides.get(other, {}))
        for path in sorted(touched) if other != chosen else ():
            if (value := _value(theirs, path)) != _value(mine, path):
                others = merged(others, nested((other, *path), value))
    return {**mine, "methods": others}


def _value(tables: Any, path: _FieldPath) -> Any:  # noqa: ANN401
    """The value at `path`, or its default if there is none."""
    default: Any = asdict(RunConfig())
    for key in path:
        tables = tables.get(key) if isinstance(tables, Mapping) else None
        default = default.get(key) if isinstance(default, Mapping) else None
    return default if tables is None else tables
