"""Packs the runs of a folder into one Parquet file, which `packed` describes."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from coop.common.errors import UsageError
from coop.common.process.files import sync_folder, write_atomic
from coop.common.process.untrusted import refuse_links
from coop.records.parquet_seals import SEAL, UNSEALED, sealed
from coop.studies.report.packed import EPISODES, METRICS, SWEEP, TEXTS, PackedStudy, decimals
from coop.studies.report.sources import FolderSource

SMALLEST = 22  # zstd's level
LEFT_OUT = ["time", "updates_per_s", "env_steps_per_s", "loss"]  # no result; thinned metrics lack them


def pack(folder: Path, path: Path, rows: int | None = None) -> str:
    """Write the runs of a folder, and its sweep.toml, into one file; return a description of the result.

    Texts are kept as they are; of the tables, the columns that hold nothing but numbers in every run.

    rows: of metrics.jsonl to keep of each run, as `thinned` chooses them; None keeps all.

    Raises:
        RunError: a file can't be read.
        UsageError: the folder holds no run, or the file cannot be written, lies in a run, or is no packed study.
    """
    source = FolderSource(folder)
    if not source.names:
        raise UsageError(f"{folder}: no folder with runs to pack")
    _check_place(path, [source.path(run) for run in source.names])
    columns = {"run": pa.array(source.names, pa.string())}
    for file in TEXTS:
        columns[file] = pa.array([source.text(run, file) for run in source.names], pa.string())
    for file in (EPISODES, METRICS):
        tables = [source.table(run, file) for run in source.names]
        if rows is not None and file == METRICS:
            tables = [thinned(table, rows) for table in tables]
        for name in dict.fromkeys(name for table in tables for name in table):
            held = [table.get(name) for table in tables]
            if all(each is None or pd.api.types.is_numeric_dtype(each) for each in held):
                columns[f"{file}/{name}"] = _lists(held, six_digits=file == EPISODES)
    try:
        write_atomic(path, study_file(pa.table(columns), source.sweep))
        sync_folder(path.parent)
    except OSError as error:
        raise UsageError(f"--pack {path}: {error.strerror or error}") from error
    return f"{path}: {len(source.names)} runs in {path.stat().st_size:,} bytes"


def _check_place(path: Path, runs: Sequence[Path]) -> None:
    """Refuse a file that is something else than a packed study, and one in a run's folder; raises UsageError."""
    refuse_links(path)
    if path.is_file():
        try:
            PackedStudy(path)
        except UsageError as error:
            raise UsageError(f"--pack: would replace {error}; name a new file") from error
    there = Path(os.path.realpath(path))  # unlike `resolve`, it bears links that lead to themselves
    if inside := next((run for run in runs if there.is_relative_to(run.resolve())), None):
        raise UsageError(f"--pack {path}: in the folder of the run {inside}; name a file outside of it")


def thinned(table: pd.DataFrame, rows: int) -> pd.DataFrame:
    """Some rows of metrics: at most `rows` at equal distances, the last one included, and those that warn.

    These have a mean |Q| above its bound. The columns LEFT_OUT are left out.
    """
    kept = np.zeros(len(table), np.bool_)
    kept[:: -max(1, math.ceil(len(table) / rows))] = True
    if {"q_abs_mean", "q_bound"} <= set(table):
        kept |= (table["q_abs_mean"] > table["q_bound"]).to_numpy()
    return table[kept].drop(columns=LEFT_OUT, errors="ignore")


def _lists(runs: Sequence[pd.Series | None], *, six_digits: bool) -> pa.Array:
    """A column of each run, null if it lacks it, in the smallest type that holds every number.

    six_digits: 32 bits hold a number if its first six digits are all of it.
    """
    values = np.concatenate([[], *(each for each in runs if each is not None)])
    kind = pa.float64()
    if all(each is None or each.dtype == np.int64 for each in runs):
        kind = pa.int64()
    else:
        with np.errstate(over="ignore"):
            narrow = values.astype(np.float32)
        if np.array_equal(decimals(narrow.tolist()) if six_digits else narrow, values, equal_nan=True):
            kind = pa.float32()
    return pa.array([None if each is None else each.to_numpy() for each in runs], pa.list_(kind))


def study_file(table: pa.Table, sweep: str | None = None) -> bytes:
    """The content of a packed study with the rows of a table and the text of sweep.toml."""
    table = table.replace_schema_metadata({SEAL: UNSEALED, **({} if sweep is None else {SWEEP: sweep})})
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
    return sealed(out.getvalue().to_pybytes())
