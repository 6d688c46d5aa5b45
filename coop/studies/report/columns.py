"""Converts the lines of episodes.csv and metrics.jsonl to typed columns, and back to the same bytes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from coop.common.numbers import exact

Columns = dict[str, list[Any]]  # values of each column by line; None if a line lacks it
LARGEST = 2**63


def csv_columns(text: str) -> Columns:
    """The cells of a CSV file, as text. Raises ValueError for a line whose length differs from the first one's."""
    header, *lines = csv.reader(io.StringIO(text))
    return dict(zip(header, map(list, zip(*lines, strict=True)), strict=True)) if lines else {n: [] for n in header}


def csv_text(columns: Mapping[str, Sequence[Any]]) -> str:
    """The CSV file of typed columns, with numbers as `RunDirectory` writes them."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(map(_cell, values) for values in columns.values()), strict=True))
    return out.getvalue()


def json_columns(text: str) -> Columns:
    """The values of a file with one JSON object per line. Raises ValueError for an invalid line."""
    rows = [json.loads(line) for line in text.splitlines()]
    return {name: [row.get(name) for row in rows] for name in in_order(rows)}


def in_order(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The names in all rows, in the order of the longest ones: a run's first row lacks some in the middle."""
    return list(dict.fromkeys(name for row in sorted(rows, key=len, reverse=True) for name in row))


def json_text(columns: Mapping[str, Sequence[Any]], as_json: frozenset[str]) -> str:
    """The JSON lines of typed columns; `as_json`: names of the columns that hold JSON."""
    lines = []
    for values in zip(*columns.values(), strict=True):
        row = {name: value for name, value in zip(columns, values, strict=True) if value is not None}
        lines.append(json.dumps({name: json.loads(row[name]) if name in as_json else row[name] for name in row}) + "\n")
    return "".join(lines)


def csv_type(columns: Sequence[Sequence[str]]) -> tuple[pa.DataType, Callable[[str], Any]]:
    """The smallest type that represents every cell of these columns exactly, and the function that reads a cell."""
    cells = [cell for column in columns for cell in column]
    if all(map(_is_integer, cells)):
        return pa.int64(), int
    # 32 bits preserve six digits, which `RunDirectory` writes for floats other than returns.
    if all(map(_is_float, cells)) and [*map(_cell, _narrow(cells).tolist())] == cells:
        return pa.float32(), float
    if all(map(_is_float, cells)) and [exact(float(cell)) for cell in cells] == cells:
        return pa.float64(), float
    return pa.string(), str


def json_type(columns: Sequence[Sequence[Any]]) -> tuple[pa.DataType, Callable[[Any], Any]]:
    """The smallest type that represents every value of these columns exactly, and the function that converts one."""
    values = [value for column in columns for value in column if value is not None]
    kinds = set(map(type, values))
    if kinds <= {int} and all(-LARGEST <= value < LARGEST for value in values):
        return pa.int64(), int
    if kinds == {float}:
        exact = np.array_equal(_narrow(values), np.array(values, np.float64), equal_nan=True)
        return (pa.float32() if exact else pa.float64()), float
    return pa.string(), json.dumps


def decimal(values: Sequence[Any]) -> list[Any]:
    """The values of a CSV column, with 32-bit floats converted back to their six digits."""
    return [float(_cell(value)) if isinstance(value, float) else value for value in values]


def _cell(value: Any) -> str:  # noqa: ANN401 (an integer, a float or text)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _narrow(values: Sequence[Any]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        return np.array(values, np.float64).astype(np.float32)


def _is_integer(cell: str) -> bool:
    try:
        return str(int(cell)) == cell and -LARGEST <= int(cell) < LARGEST
    except ValueError:
        return False


def _is_float(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
