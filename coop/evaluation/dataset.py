"""Writes a buffer to a Parquet file, one row a transition."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path

from coop.common.errors import RunError, UsageError
from coop.common.process.files import make_folder, sync_file, sync_folder
from coop.evaluation.buffer import Buffer
from coop.evaluation.saved import SavedRun

ROWS_AT_ONCE = 1024  # in memory as Arrow's arrays, and a row group of the file


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
    part = file.with_name(f"{file.name}.part")
    try:
        make_folder(file.parent)
        try:
            part.unlink(missing_ok=True)  # of an export that was killed
            _write(buffer, part)
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
    schema = pa.schema(fields, {"env_id": buffer.spec.env_id, "checkpoint": str(buffer.checkpoint)})
    with path.open("xb") as file, pq.ParquetWriter(file, schema) as writer:
        for start in range(0, len(buffer), ROWS_AT_ONCE):
            rows = slice(start, start + ROWS_AT_ONCE)
            arrays = [pa.array(array[rows].ravel()) for array in columns.values()]
            lists = [
                pa.FixedSizeListArray.from_arrays(array, type=field.type)
                if pa.types.is_fixed_size_list(field.type)
                else array
                for array, field in zip(arrays, schema, strict=True)
            ]
            writer.write_table(pa.Table.from_arrays(lists, schema=schema))
