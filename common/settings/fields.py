"""Types of single settings, with the bounds ."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
import tomli_w
from msgspec import Meta
from tyro.constructors import PrimitiveConstructorSpec

from coop.common.bounds import MAX_INTEGER, MAX_KWARGS, MAX_STEPS
from coop.common.errors import UsageError
from coop.common.settings.reading import MAX_DEPTH, Read, parse_toml

Positive = Annotated[int, Meta(gt=0, le=MAX_INTEGER)]
Steps = Annotated[int, Meta(gt=0, le=MAX_STEPS)]
PositiveFloat = Annotated[float, Meta(gt=0, le=sys.float_info.max)]
NonNegative = Annotated[float, Meta(ge=0, le=sys.float_info.max)]
PositiveShare = Annotated[float, Meta(gt=0, le=1)]
Decay = Annotated[float, Meta(ge=0, lt=1)]
SWITCH = Read(lambda value: {True: "async", False: "off"}[value] if isinstance(value, bool) else value)
NONE = Read(lambda value: None if isinstance(value, str) and value in ("None", "none") else value)
"""Lets an optional field be unset in TOML too, which has no null: "None"."""


def _read_table(words: Sequence[str]) -> dict[str, Any]:
    """Read an inline TOML table from the command line, such as "{side = 12}"."""
    try:
        tables = parse_toml(f"table = {words[0]}")
    except UsageError as error:
        raise ValueError(f"{words[0]!r} is no inline TOML table: {error}") from None
    if tables.keys() != {"table"} or not isinstance(tables["table"], dict):
        raise ValueError(f"{words[0]!r} is no inline TOML table, such as {{side = 12}}")
    return tables["table"]


def _show_table(table: dict[str, Any]) -> list[str]:
    """The table as inline TOML, which tomli_w writes within a list."""
    return [tomli_w.dumps({"t": [table]}).split("[", 1)[1].rpartition("]")[0].strip().rstrip(",")]


def _transferable(table: Any) -> Any:  # noqa: ANN401 (another type is refused with those of other fields)
    """Refuse values that a TOML file or a message could not carry."""
    if not isinstance(table, dict):
        return table
    _check_values(table, MAX_DEPTH - 3)  # below env and kwargs in a file
    if (size := len(msgspec.msgpack.encode(table))) > MAX_KWARGS:
        raise ValueError(f"{size:,} bytes; allowed: at most {MAX_KWARGS:,}")
    return table


def _check_values(value: Any, depth: int) -> None:  # noqa: ANN401 (whatever the table holds)
    if depth < 0 and isinstance(value, dict | list):
        raise ValueError(f"nests more than {MAX_DEPTH - 3} tables and lists")
    match value:
        case dict():
            if not all(isinstance(key, str) for key in value):
                raise ValueError("names must be strings")
            for each in value.values():
                _check_values(each, depth - 1)
        case list():
            for each in value:
                _check_values(each, depth - 1)
        case bool() | str():
            pass
        case int() if -MAX_INTEGER <= value <= MAX_INTEGER:
            pass
        case float() if math.isfinite(value):
            pass
        case _:
            raise ValueError(f"{value!r}: allowed: strings, booleans, finite numbers, lists and tables of them")


Table = Annotated[
    dict[str, Any],
    Read(_transferable),
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="TABLE",
        instance_from_str=_read_table,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=_show_table,
    ),
]
"""A TOML table with any values; on the command line an inline table."""
