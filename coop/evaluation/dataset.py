"""Writes a buffer to a Parquet file, one row a transition, or whole episodes to a Minari data set."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path

from coop.common.errors import RunError, UsageError
from coop.common.imports import check_extra
from coop.common.places import shown
from coop.common.process.files import make_folder, part_of, sync_file, sync_folder
from coop.evaluation.buffer import Buffer
from coop.evaluation.minari import NotWholeError, export_minari
from coop.evaluation.saved import SavedRun
from coop.records.datasets import TRANSITIONS
from coop.records.parquet_seals import SEAL, SIZE, UNSEALED, UNSIZED, seal_file

ROWS_AT_ONCE = 1024  # in memory as Arrow's arrays, and a row group of the file
GROUP_BYTES = 1 << 26  # of a row group, in which pictures are fewer


def export_to(run_dir: Path, path: Path) -> str:
    """Write a run's transitions to a file that ends in .parquet, or to a new folder; return what was written, in words.

    A folder gets a Minari data set of whole episodes, or a Parquet file where the run has none.

    Raises:
        UsageError: the run has no transitions here, or `path` exists.
        RunError: a library is not installed, or `path` cannot be written.
    """
    if path.suffix == ".parquet":
        buffer, why = export_dataset(run_dir, path), ""
        return f"checkpoint {buffer.checkpoint} in {shown(run_dir)}: {len(buffer):,} transitions in {shown(path)}"
    if path.exists() or path.is_symlink():
        raise UsageError(f"--dataset {path}: exists already; name a new folder")
    try:
        check_extra("a Minari data set", "minari", "h5py")
        check_extra("a Minari data set", "minari", "minari")
        return f"{shown(run_dir)}: {export_minari(run_dir, path)} in {shown(path)}"
    except (NotWholeError, UsageError) as error:
        why = str(error)
    buffer = export_dataset(run_dir, path / TRANSITIONS)
    place = shown(path / TRANSITIONS)
    told = f"checkpoint {buffer.checkpoint} in {shown(run_dir)}: {len(buffer):,} transitions in {place}"
    return f"{told}, not as episodes of Minari: {why}"


def export_dataset(run_dir: Path, file: Path) -> Buffer:
    """Write the buffer of a run's newest whole checkpoint to the Parquet file `file`, completely or not at all.

    Raises:
        UsageError: the run has no buffer, or `file` exists.
        RunError: pyarrow is not installed, or `file` cannot be written.
    """
    if find_spec("pyarrow") is None:
        raise RunError("pyarrow is not installed; it comes with the extra report: pip install 'coop-rl[report]'")
    if file.exists() or file.is_symlink():
        raise UsageError(f"--dataset {file}: exists already; name a new file")
    buffer = SavedRun(run_dir).buffer()
    part = part_of(file)
    try:
        make_folder(file.parent)
        try:
            _write(buffer, part)
            seal_file(part)
            sync_file(part)
            part.replace(file)
        finally:
            part.unlink(missing_ok=True)
        sync_folder(file.parent)
    except OSError as error:
        raise RunError(f"{error.filename or file}: {error.strerror or error}") from error
    return buffer


def _write(buffer: Buffer, path: Path) -> None:
    """Write a column for each array; observations are lists of fixed size, whose shape the metadata give as JSON."""
    import pyarrow as pa  # noqa: PLC0415 (an extra, which may be missing)
    import pyarrow.parquet as pq  # noqa: PLC0415

    columns = buffer.columns()
    fields = []
    for name, array in columns.items():
        kind, shape = pa.from_numpy_dtype(array.dtype), list(array.shape[1:])
        stored = pa.list_(kind, math.prod(shape)) if shape else kind
        fields.append(pa.field(name, stored, nullable=False, metadata={"shape": str(shape)}))
    facts = {"env_id": buffer.spec.env_id, "checkpoint": str(buffer.checkpoint)}
    schema = pa.schema(fields, {**facts, SEAL: UNSEALED, SIZE: UNSIZED})
    with path.open("xb") as file, pq.ParquetWriter(file, schema, write_page_checksum=True) as writer:
        row_bytes = sum(array[:1].nbytes for array in columns.values())
        at_once = max(1, min(ROWS_AT_ONCE, GROUP_BYTES // max(1, row_bytes)))
        for start in range(0, len(buffer), at_once):
            rows = slice(start, start + at_once)
            arrays = [pa.array(array[rows].ravel()) for array in columns.values()]
            lists = [
                pa.FixedSizeListArray.from_arrays(array, type=field.type)
                if pa.types.is_fixed_size_list(field.type)
                else array
                for array, field in zip(arrays, schema, strict=True)
            ]
            writer.write_table(pa.Table.from_arrays(lists, schema=schema))
