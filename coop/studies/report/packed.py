"""Reads a packed study: one Parquet file with a row per run, as `packing` writes it.

Columns: `run`, the folder's name; `config.toml`, `summary.json` and `evaluations.csv`, their text; and for each column
of numbers in `episodes.csv` and `metrics.jsonl` a list, named like `episodes.csv/return`. The schema's metadata hold
`sweep.toml`. Every page has a checksum, and the metadata hold one of the whole file, for what pages don't cover.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from coop.common.errors import UsageError
from coop.common.process.untrusted import check_run_name, page_sizes
from coop.records.checkpoints import EVALUATIONS
from coop.records.parquet_seals import has_seal

SWEEP, CONFIG, SUMMARY, EPISODES, METRICS = "sweep.toml", "config.toml", "summary.json", "episodes.csv", "metrics.jsonl"
TEXTS = (CONFIG, SUMMARY, EVALUATIONS)
MAX_STUDY = 1 << 30  # bytes of a study in memory


class PackedStudy:
    """Reads a packed study, whoever packed it. Raises UsageError if the file is none, or a run's name is none."""

    def __init__(self, path: Path) -> None:
        try:
            if path.stat().st_size > MAX_STUDY:
                raise ValueError(f"{path.stat().st_size:,} bytes; a study has at most {MAX_STUDY:,}")
            content = path.read_bytes()
            if (sealed := has_seal(content)) is None:
                raise ValueError("has no checksum")
            if not sealed:
                raise UsageError(f"{path}: wrong checksum: not what was packed")
            self._table = _read_bounded(content)
            self.names = [str(name) for name in self._table["run"].to_pylist()]
        except (OSError, KeyError, ValueError, pa.ArrowException) as error:
            text = (str(error).splitlines() or [type(error).__name__])[0]
            raise UsageError(f"{path}: not a packed study: {text}") from error
        for name in self.names:
            check_run_name(name, str(path))
        self._rows = {name: row for row, name in enumerate(self.names)}
        if len(self._rows) < len(self.names):
            raise UsageError(f"{path}: not a packed study: two runs have one name")
        sweep = (self._table.schema.metadata or {}).get(SWEEP.encode())
        self.sweep = None if sweep is None else sweep.decode()

    def text(self, run: str, file: str) -> str | None:
        """The content of one of a run's TEXTS; None if there is none."""
        if run not in self._rows or file not in self._table.column_names:
            return None
        text: str | None = self._table[file][self._rows[run]].as_py()
        return text

    def columns(self, run: str, file: str, wanted: Sequence[str], optional: Sequence[str] = ()) -> dict[str, list[Any]]:
        """Some columns of a run's episodes or metrics, None if an optional one is missing.

        Raises KeyError if the run lacks a wanted one.
        """
        row, names = self._rows[run], self._table.column_names
        asked = {name: f"{file}/{name}" for name in (*wanted, *optional) if f"{file}/{name}" in names}
        held = {name: value for name in asked if (value := self._table[asked[name]][row]).is_valid}
        if not held and not any(self._table[name][row].is_valid for name in names if name.startswith(f"{file}/")):
            return {name: [] for name in (*wanted, *optional)}
        six = pa.list_(pa.float32()) if file == EPISODES else None
        read = {name: decimals(each.as_py()) if each.type == six else each.as_py() for name, each in held.items()}
        lacking: list[Any] = [None] * len(next(iter(read.values()), ()))
        return {name: read[name] for name in wanted} | {name: read.get(name, lacking) for name in optional}

    def table(self, run: str, file: str) -> pd.DataFrame:
        """All columns of a run's episodes or metrics that are packed, empty if it has none."""
        names = [name.removeprefix(f"{file}/") for name in self._table.column_names if name.startswith(f"{file}/")]
        return pd.DataFrame(self.columns(run, file, (), names)).dropna(axis=1, how="all")


def decimals(values: Sequence[float]) -> list[float]:
    """Convert 32-bit floats back to the six digits of which they were made."""
    return [float(f"{value:.6g}") for value in values]


def _read_bounded(content: bytes) -> pa.Table:
    """Read a table, texts as indices of their different values, and spread these only if the result is not too large.

    Raises ValueError for a table that would take more than `MAX_STUDY` bytes, before it takes them.
    """
    with pq.ParquetFile(pa.BufferReader(content)) as file:
        meta, leaves = file.metadata, file.schema
        columns = range(meta.num_columns)
        values = packed = 0
        for column in (meta.row_group(group).column(n) for group in range(meta.num_row_groups) for n in columns):
            start = column.dictionary_page_offset or column.data_page_offset
            pages = list(page_sizes(content, start, column.total_compressed_size))
            values += max(column.num_values, sum(held for _, held in pages))
            packed += sum(size for size, _ in pages)
        if 8 * values + packed > MAX_STUDY:
            raise ValueError(f"{values:,} values, {packed:,} bytes; a study has at most {MAX_STUDY:,} bytes")
        texts = [leaves.column(n).path for n in columns if leaves.column(n).physical_type == "BYTE_ARRAY"]
    table = pq.ParquetFile(pa.BufferReader(content), read_dictionary=texts, page_checksum_verification=True).read()
    spread = sum(map(_spread, table.columns))
    if spread > MAX_STUDY:
        raise ValueError(f"{spread:,} bytes of text; a study has at most {MAX_STUDY:,}")
    return table


def _spread(column: pa.ChunkedArray) -> int:
    """Bytes of a column's texts, each written out."""
    total = 0
    for chunk in column.chunks:
        leaf = chunk.flatten() if pa.types.is_list(chunk.type) else chunk
        if isinstance(leaf, pa.DictionaryArray):
            each = pc.binary_length(leaf.dictionary).take(leaf.indices)
            total += pc.sum(each).as_py() or 0
    return total
