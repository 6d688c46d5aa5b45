"""Packs a study into one Parquet file with a row per run, and restores every file of the runs byte for byte.

Columns: `run`, the folder's name; `config.toml`, `summary.json` and `evaluations.csv`, their text; and a list for each
column of `episodes.csv` and `metrics.jsonl`, named like `episodes.csv/return`. The schema's metadata hold `sweep.toml`.

Every page has a checksum, and the metadata hold one of the whole file, for what pages don't cover. A file without
one is looked up in SHA256SUMS beside it; one that is in neither is read with a warning.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from coop.common.errors import RunError, UsageError
from coop.common.numbers import exact
from coop.common.process.files import sync_folder, write_atomic
from coop.common.process.notices import warn
from coop.common.process.untrusted import MAX_SETTINGS, check_links, check_run_name, page_sizes, read_text
from coop.records.evaluations import EVALUATIONS
from coop.records.summaries import parse_summary, summary_text
from coop.studies.report.columns import (
    Columns,
    csv_columns,
    csv_text,
    csv_type,
    decimal,
    in_order,
    json_columns,
    json_text,
    json_type,
)

SWEEP, CONFIG, SUMMARY, EPISODES, METRICS = "sweep.toml", "config.toml", "summary.json", "episodes.csv", "metrics.jsonl"
TEXTS = (CONFIG, SUMMARY, EVALUATIONS)
FILES = (*TEXTS, EPISODES, METRICS)
READ: Mapping[str, Callable[[str], Columns]] = {EPISODES: csv_columns, METRICS: json_columns}
TYPE: Mapping[str, Callable[[Sequence[Sequence[Any]]], tuple[pa.DataType, Callable[[Any], Any]]]] = {
    EPISODES: csv_type,
    METRICS: json_type,
}
JSON = {b"holds": b"json"}
SMALLEST = 22  # zstd's level
# No result: what the machine was doing, and long lists. A thinned file lacks them.
LEFT_OUT = ("time", "updates_per_s", "env_steps_per_s", "loss", "sample_age_histogram", "reuse_histogram")
MAX_STUDY = 1 << 30  # bytes of a study in memory
SUMS = "SHA256SUMS"  # as sha256sum writes it
SEAL, UNSEALED = "coop", "crc32 of the rest:00000000"  # an entry of the metadata; with its digits the checksum
_SEALED = re.compile(rb"crc32 of the rest:[0-9a-f]{8}")


class PackedStudy:
    """Reads a packed study, whoever packed it. Raises UsageError if the file is none, or a run's name is none."""

    def __init__(self, path: Path) -> None:
        try:
            if path.stat().st_size > MAX_STUDY:
                raise ValueError(f"{path.stat().st_size:,} bytes; a study has at most {MAX_STUDY:,}")
            content = path.read_bytes()
            check_content(path, content)
            self._table = _read_bounded(content)
            self.names = [str(name) for name in self._table["run"].to_pylist()]
        except (OSError, KeyError, ValueError, pa.ArrowException) as error:
            text = (str(error).splitlines() or [type(error).__name__])[0]
            raise UsageError(f"{path}: not a packed study: {text}") from error
        if SEAL.encode() in (self._table.schema.metadata or {}) and not _SEALED.search(content):
            raise UsageError(f"{path}: wrong checksum: not what was packed")
        for name in self.names:
            check_run_name(name, str(path))
        self._rows = {name: row for row, name in enumerate(self.names)}
        if len(self._rows) < len(self.names):
            raise UsageError(f"{path}: not a packed study: two runs have one name")
        sweep = (self._table.schema.metadata or {}).get(SWEEP.encode())
        self.sweep = None if sweep is None else sweep.decode()

    def text(self, run: str, file: str) -> str | None:
        """The content of a run's file; None if there is none."""
        if run not in self._rows:
            return None
        if file in TEXTS and file not in self._table.column_names:
            return None  # packed by an earlier version
        if file in TEXTS:
            text: str | None = self._value(run, file).as_py()
            return text
        columns = {name: _cells(file, value) for name, value in self._columns(run, file).items()}
        if not columns:
            return ""
        if file == EPISODES:
            return csv_text(columns)
        schema = self._table.schema
        as_json = (name for name in columns if (schema.field(f"{file}/{name}").metadata or {}).items() >= JSON.items())
        return json_text(columns, frozenset(as_json))

    def columns(self, run: str, file: str, wanted: Sequence[str], optional: Sequence[str] = ()) -> Columns:
        """Some columns of a run's episodes or metrics, None if an optional one is missing.

        Raises KeyError if the run lacks a wanted one.
        """
        columns = self._columns(run, file)
        if not columns:
            return {name: [] for name in (*wanted, *optional)}
        read = decimal if file == EPISODES else list
        lacking: list[Any] = [None] * len(next(iter(columns.values())))
        found = {name: read(_cells(file, columns[name])) for name in wanted}
        return found | {name: read(_cells(file, columns[name])) if name in columns else lacking for name in optional}

    def _columns(self, run: str, file: str) -> dict[str, pa.Scalar]:
        start = f"{file}/"
        values = {name: self._value(run, name) for name in self._table.column_names if name.startswith(start)}
        return {name.removeprefix(start): value for name, value in values.items() if value.is_valid}

    def _value(self, run: str, column: str) -> pa.Scalar:
        return self._table[column][self._rows[run]]


def _cells(file: str, value: pa.Scalar) -> list[Any]:
    """A column of a run; of episodes.csv as text where its numbers need 64 bits."""
    cells: list[Any] = value.as_py()
    return [*map(exact, cells)] if file == EPISODES and value.type.value_type == pa.float64() else cells


def pack(folder: Path, path: Path, rows: int | None = None) -> str:
    """Write the runs of a folder, and its sweep.toml, into one file; return a description of the result.

    rows: of metrics.jsonl to keep of each run, as `thinned` chooses them; None keeps all. Everything else is kept as it
    is.

    An empty file is restored as an empty file, and so is a run's missing table.

    Raises:
        RunError: a file is torn, or cannot be restored byte for byte.
        UsageError: the folder holds no run, or the file cannot be written.
    """
    runs = run_names(folder)
    if not runs:
        raise UsageError(f"{folder}: no folder with runs to pack")
    for run in runs:
        check_links(folder / run)
    files = {run: {file: _file(folder / run / file) for file in FILES} for run in runs}
    if rows is not None:
        for run, texts in files.items():
            texts[METRICS] = _thinned(folder / run / METRICS, texts[METRICS], rows)
            texts[SUMMARY] = _without_seal(texts[SUMMARY], METRICS, folder / run / SUMMARY)
    fields: list[tuple[pa.Field, pa.Array]] = [(pa.field("run", pa.string()), pa.array(runs, pa.string()))]
    for file in TEXTS:
        fields.append((pa.field(file, pa.string()), pa.array([files[run][file] for run in runs], pa.string())))
    for file in READ:
        fields += _lists(file, [_read(folder / run / file, files[run][file]) for run in runs])
    sweep = _file(folder / SWEEP)
    metadata = {SEAL: UNSEALED, **({} if sweep is None else {SWEEP: sweep})}
    schema = pa.schema([field for field, _ in fields], metadata)
    part = path.with_name(f"{path.name}.part")
    try:
        write_atomic(part, _packed(pa.table([array for _, array in fields], schema=schema)))
        _check(PackedStudy(part), folder, files)
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise UsageError(f"--pack {path}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    held = sum(len(text.encode()) for run in runs for text in files[run].values() if text)
    return f"{path}: {len(runs)} runs, {held:,} bytes in {path.stat().st_size:,}"


def unpack(path: Path, folder: Path) -> str:
    """Restore the files of a packed study; return a description of the result.

    Raises UsageError if the file is no packed study, or the folder exists already or cannot be written.
    """
    packed = PackedStudy(path)
    try:
        folder.mkdir(parents=True)
        if packed.sweep is not None:
            write_atomic(folder / SWEEP, packed.sweep.encode())
        for run in packed.names:
            (folder / run).mkdir()
            for file in FILES:
                text = packed.text(run, file)
                if text is not None:
                    write_atomic(folder / run / file, text.encode())
    except OSError as error:
        raise UsageError(f"--unpack {folder}: {error.strerror}") from error
    return f"{folder}: {len(packed.names)} runs"


def thinned(text: str, rows: int) -> str:
    """Some lines of metrics.jsonl: at most `rows` at equal distances, the last one included, and those that warn.

    These have a mean |Q| above its bound. The columns LEFT_OUT are left out.
    """
    lines = [json.loads(line) for line in text.splitlines()]
    kept = set(range(len(lines) - 1, -1, -max(1, math.ceil(len(lines) / rows))))
    kept |= {number for number, row in enumerate(lines) if row.get("q_abs_mean", 0) > row.get("q_bound", math.inf)}
    short = ({name: value for name, value in lines[n].items() if name not in LEFT_OUT} for n in sorted(kept))
    return "".join(json.dumps(row) + "\n" for row in short)


def _thinned(path: Path, text: str | None, rows: int) -> str | None:
    try:
        return text and thinned(text, rows)
    except ValueError as error:
        raise RunError(f"{path}: a torn line; is the run still writing? {error}") from error


def _without_seal(text: str | None, name: str, path: Path) -> str | None:
    """The text of a summary that no longer seals one of the records, which has been changed on purpose."""
    if not text:
        return text
    fields = parse_summary(text, path)
    if name not in fields.get("records", {}):
        return text
    return summary_text({**fields, "records": {each: seal for each, seal in fields["records"].items() if each != name}})


def run_names(folder: Path) -> list[str]:
    """The names of the runs in a folder, in order, without hidden folders; raises UsageError as `check_run_name`."""
    found = (path.parent.name for path in folder.glob(f"*/{CONFIG}"))
    return sorted(check_run_name(name, str(folder)) for name in found if not name.startswith("."))


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


def _check(packed: PackedStudy, folder: Path, files: Mapping[str, Mapping[str, str | None]]) -> None:
    for run, texts in files.items():
        for file, text in texts.items():
            if (packed.text(run, file) or "") != (text or ""):
                raise RunError(f"{folder / run / file}: cannot be restored byte for byte; nothing was packed")


def _file(path: Path) -> str | None:
    try:
        return path.read_bytes().decode()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path}: can't be read: {error}") from error


def _read(path: Path, text: str | None) -> Columns:
    try:
        return READ[path.name](text) if text else {}
    except ValueError as error:
        raise RunError(f"{path}: a torn line; is the run still writing? {error}") from error


def _lists(file: str, runs: Sequence[Columns]) -> list[tuple[pa.Field, pa.Array]]:
    """Each column of a file, as one list per run; null if the run lacks it."""
    made = []
    for name in in_order(runs):
        kind, convert = TYPE[file]([run[name] for run in runs if name in run])
        lists = [[None if v is None else convert(v) for v in run[name]] if name in run else None for run in runs]
        metadata = JSON if file == METRICS and kind == pa.string() else None
        kind = pa.list_(kind)
        made.append((pa.field(f"{file}/{name}", kind, metadata=metadata), pa.array(lists, kind)))
    return made


def _packed(table: pa.Table) -> bytes:
    encodings, texts = {}, []
    for field in table.schema:
        leaf = f"{field.name}.list.element" if pa.types.is_list(field.type) else field.name
        kind = field.type.value_type if pa.types.is_list(field.type) else field.type
        if pa.types.is_string(kind):
            texts.append(leaf)
        else:
            encodings[leaf] = "DELTA_BINARY_PACKED" if pa.types.is_integer(kind) else "BYTE_STREAM_SPLIT"
    out = pa.BufferOutputStream()
    pq.write_table(
        table, out, compression="zstd", compression_level=SMALLEST, use_dictionary=texts, column_encoding=encodings,
        write_statistics=False, data_page_size=1 << 30, write_page_checksum=True,
    )  # fmt: skip
    content: bytes = out.getvalue().to_pybytes()
    place = content.rindex(UNSEALED.encode())
    return content[:place] + _sealed(content).encode() + content[place + len(UNSEALED) :]


def check_content(path: Path, content: bytes) -> None:
    """Check the checksum of a whole packed study, or of a file beside it, which SHA256SUMS holds for older ones.

    Raises UsageError if it differs; warns if there is none.
    """
    found = list(_SEALED.finditer(content))
    if found:
        start, end = found[-1].span()
        unsealed = content[:start] + UNSEALED.encode() + content[end:]
        if found[-1][0].decode() != _sealed(unsealed):
            raise UsageError(f"{path}: wrong checksum: not what was packed")
        return
    sums = path.with_name(SUMS)
    lines = read_text(sums, MAX_SETTINGS).splitlines() if sums.exists() else []
    listed = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    if path.name not in listed:
        warn(f"{path}: has no checksum, as earlier versions wrote it")
    elif listed[path.name] != hashlib.sha256(content).hexdigest():
        raise UsageError(f"{path}: wrong checksum: not what {sums} lists")


def _sealed(content: bytes) -> str:
    return f"{UNSEALED[:-8]}{zlib.crc32(content):08x}"
