"""Reads the text records of a run: whole lines only, after the checksums that a summary or a checkpoint seals.

A half line at the end is said, and a line that can't be read is named.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coop.common.errors import RunError, UsageError, first_line
from coop.common.process.output import warn, warn_once
from coop.common.process.untrusted import MAX_SETTINGS, check_run_name, read_bytes, read_text
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import CONFIG, parse_run_config
from coop.records.checkpoints import (
    Damaged,
    check_record,
    checked_summary,
    checkpoint_numbers,
    checkpoint_path,
    read_manifest,
)
from coop.records.run_ids import has_run_id
from coop.records.summaries import SUMMARY

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
TAIL = 16_384  # bytes at the end of a CSV record, enough for 100 lines of episodes.csv


def run_names(folder: Path) -> list[str]:
    """The names of the runs in a folder, in order, without hidden folders; names that are none are warned of once."""
    found = []
    for name in sorted(path.parent.name for path in folder.glob(f"*/{CONFIG}")):
        try:
            if not name.startswith("."):
                found.append(check_run_name(name, str(folder)))
        except UsageError as error:
            warn_once(f"{error}; left out")
    return found


def check_records(run_dir: Path) -> None:
    """Check the records of a run against its summary; of one that has not ended, against its newest checkpoint.

    Raises RunError if they hold something else.
    """
    if (run_dir / SUMMARY).exists():
        checked_summary(run_dir)
        return
    for number in reversed(checkpoint_numbers(run_dir)):
        try:
            manifest = read_manifest(checkpoint_path(run_dir, number))
        except Damaged:
            continue
        try:
            for name, written in manifest.records.items():
                check_record(run_dir / name, written)
        except Damaged as damaged:
            raise RunError(f"{run_dir}: can't be read as it was written: {damaged}") from damaged
        return


def read_lines(path: Path) -> list[str]:
    """The whole lines of a record. A warning names a half one at the end, as a kill or a live run leaves it.

    Raises:
        RunError: it can't be read, or holds other bytes than text; names the line.
        FileNotFoundError: there is none.
    """
    try:
        data = read_bytes(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise RunError(f"{path}: can't be read: {error.strerror or error}") from error
    whole, newline, half = data.rpartition(b"\n")
    if half:
        last = whole.count(b"\n") + 2 if newline else 1
        warn(f"{path}: line {last}, the last one, is incomplete, and left out")
    if (place := data.find(b"\0")) >= 0:
        line = data[:place].count(b"\n") + 1
        raise RunError(f"{path}, line {line}: holds a NUL byte")
    try:
        return (whole + newline).decode().split("\n")[:-1]
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise RunError(f"{path}, line {line}: not text") from error


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV record; raises as `read_lines`, and for a row with another number of values than the header."""
    reader = csv.reader(read_lines(path))
    try:
        header: list[str] = next(reader, [])
        rows = []
        for row in reader:
            if len(row) != len(header):
                raise RunError(f"{path}, line {reader.line_num}: {len(row)} values instead of {len(header)}")
            rows.append(dict(zip(header, row, strict=True)))
    except csv.Error as error:
        raise RunError(f"{path}, line {reader.line_num}: can't be read: {error}") from error
    return rows


def read_jsonl(path: Path) -> list[dict[str, Any]]:
    """The rows of a record with a JSON object on each line; raises as `read_lines`, and for another line."""
    return [parse_row(line, f"{path}, line {number}") for number, line in enumerate(read_lines(path), 1)]


def read_frame(path: Path) -> pd.DataFrame:
    """A CSV record with the types that its values have, without columns if it is empty; raises as `read_csv`."""
    import pandas as pd  # noqa: PLC0415 (half a second, which a learner does not need)

    read_csv(path)  # names a line that pandas would fill up
    lines = read_lines(path)
    try:
        return pd.read_csv(io.StringIO("\n".join(lines))) if lines else pd.DataFrame()
    except ValueError as error:  # what pandas takes for no CSV; it names the line
        raise RunError(f"{path}: can't be read: {first_line(error)}") from error


def read_csv_tail(path: Path, most: int) -> list[dict[str, str]]:
    """The last rows, `most` at most, of a CSV record that may be growing, without reading the rest of it.

    Raises:
        RunError: it can't be read, or has other values than the header says.
    """
    try:
        with path.open("rb") as file:
            header = file.readline(TAIL)
            start = os.fstat(file.fileno()).st_size - TAIL
            file.seek(max(len(header), start))
            lines = file.read().decode().rpartition("\n")[0].splitlines()[1 if start > len(header) else 0 :]
        names = header.decode().strip().split(",")
        return [dict(zip(names, values, strict=True)) for values in csv.reader(lines[-most:])]
    except (OSError, ValueError, csv.Error) as error:
        raise RunError(f"{path}: can't be read: {error}") from error


def parse_row(line: str | bytes, place: str) -> dict[str, Any]:
    """A line of JSON; place: for the error. Raises RunError."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise RunError(f"{place}: not JSON: {error}") from error
    if not isinstance(row, dict):
        raise RunError(f"{place}: no JSON object")
    return row


def column(rows: Sequence[dict[str, Any]], name: str, path: Path, first: int, *, optional: bool = False) -> list[Any]:
    """A column of numbers, None where an optional one is missing; first: number of the first row's line.

    Raises RunError for a value that is no number; names the line.
    """
    values: list[Any] = []
    for number, row in enumerate(rows, first):
        try:
            value = row.get(name) if optional else row[name]
            values.append(float(value) if isinstance(value, str) else value)
        except (KeyError, ValueError) as error:
            raise RunError(f"{path}, line {number}: {name}: {error}") from error
        if not isinstance(values[-1], int | float | None):
            raise RunError(f"{path}, line {number}: {name} = {values[-1]!r}: no number")
    return values


def read_run_config(run_dir: Path) -> RunConfig:
    """Read a run's config.toml, after a check of its checksum; raises UsageError."""
    path = run_dir / CONFIG
    try:
        text = read_text(path, MAX_SETTINGS)
    except (OSError, UnicodeDecodeError, RunError) as error:
        raise UsageError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    # A config without a run, as a user writes it or takes it from a packed study, has neither.
    return parse_run_config(text, path, needed=has_run_id(run_dir))


def returns_by_step(text: str) -> Floats:
    """Environment steps, in order, and mean returns, of the lines with the least epsilon: float64 [2, lines].

    Raises ValueError, TypeError or KeyError for a line that is none.
    """
    try:
        rows = list(csv.DictReader(text.splitlines()))
    except csv.Error as error:
        raise ValueError(str(error)) from error
    least = min((float(row["epsilon"]) for row in rows), default=0.0)
    found = [(float(row["env_step"]), float(row["return_mean"])) for row in rows if float(row["epsilon"]) == least]
    return np.array(sorted(found), np.float64).reshape(-1, 2).T
