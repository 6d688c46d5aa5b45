"""Reads transitions from a data set: a Parquet file, as `coop-export` writes it, or the folder of a Minari data set.

Data sets are somebody's. What a file declares is compared with the environment, and with the bytes that are there,
before memory is taken for it; rows are read some at a time.
"""

from __future__ import annotations

import json
import math
import mmap
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coop.common.bounds import MAX_N_STEP
from coop.common.errors import CoopError, UsageError, first_line
from coop.common.imports import check_extra
from coop.common.process.untrusted import MAX_SETTINGS, page_sizes, read_text
from coop.common.transitions import MASKS
from coop.common.types import Array, EnvSpec
from coop.records.parquet_seals import has_seal

if TYPE_CHECKING:
    import pyarrow as pa

ROWS = 512  # read at once
MAX_AT_ONCE = 1 << 30  # bytes of a row group's columns, or of a chunk
TRANSITIONS = "transitions.parquet"
"""The Parquet file of a folder that `coop-export` makes where it can't write whole episodes."""
MINARI = "main_data.hdf5"
_EPISODE = re.compile(r"episode_(\d{1,18})")
_BYTES = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT64": 8, "DOUBLE": 8}  # of Parquet's values in memory
_COLUMNS = ("observations", "next_observations", "actions", "rewards", "terminated")
_OPTIONAL = ("truncated", "episode", "span")


@dataclass(frozen=True)
class Rows:
    """Consecutive transitions of a data set, n of them.

    Attributes:
        obs, next_obs: <frame_dtype>[n, *obs_shape].
        actions: int32 [n]. rewards: float32 [n]. terminated: bool [n].
        ends: bool [n], whether an episode ends with it; of the last of these only if the data say so.
        span: uint8 [n], environment steps from obs to next_obs.
        mask, next_mask: bool [n, actions], as in `Masked`; None unless the environment has action masks.
    """

    obs: Array
    next_obs: Array
    actions: NDArray[np.int32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    ends: NDArray[np.bool_]
    span: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None = None
    next_mask: NDArray[np.bool_] | None = None


def read_rows(path: Path, spec: EnvSpec, source: str) -> Iterator[Rows]:
    """Yield the transitions of a data set of this environment, at most `ROWS` at once.

    source: what names the data set, for messages.

    Raises:
        UsageError: there is no data set, it has other observations or actions than the environment, or is damaged.
    """
    try:
        yield from _rows(path, spec, source)
    except CoopError:
        raise
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError) as error:
        ours = type(error) is ValueError and str(error)  # pyarrow's and h5py's are of these, too
        raise UsageError(f"{source}: {str(error).splitlines()[0] if ours else first_line(error)}") from error


def check_data_set(path: Path, spec: EnvSpec, source: str) -> None:
    """Read the beginning of a data set; raises as `read_rows`."""
    next(read_rows(path, spec, source), None)


def _rows(path: Path, spec: EnvSpec, source: str) -> Iterator[Rows]:
    if not path.exists():
        raise UsageError(f"{source}: does not exist")
    file = path / TRANSITIONS if (path / TRANSITIONS).is_file() else path
    if file.is_file():
        check_extra(source, "report", "pyarrow")
        return _of_parquet(file, spec)
    folder = path / "data" if (path / "data").is_dir() else path
    if (folder / MINARI).is_file():
        check_extra(source, "minari", "h5py")
        return _of_minari(folder, spec)
    raise UsageError(f"{source}: neither a Parquet file nor the folder of a Minari data set in HDF5, data/{MINARI}")


def _of_parquet(path: Path, spec: EnvSpec) -> Iterator[Rows]:
    import pyarrow.parquet as pq  # noqa: PLC0415 (an extra)

    with path.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if has_seal(content) is False:
            raise ValueError("wrong checksum: not what was exported")
        with pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True) as file:
            there = set(file.schema_arrow.names)
            needed = (*_COLUMNS, *(MASKS if spec.masks else ()))
            if missing := [name for name in needed if name not in there]:
                raise ValueError(f"has no column {missing[0]}; needed: {', '.join(needed)}")
            names = [*needed, *(name for name in _OPTIONAL if name in there)]
            _check_groups(file, content, names)
            before: Rows | None = None
            episode = None  # of the last transition
            for batch in file.iter_batches(ROWS, columns=names):
                columns = {name: _values(name, batch.column(name), spec) for name in names}
                if before is not None:
                    before.ends[-1] |= "episode" in columns and columns["episode"][0] != episode
                    yield before
                before, episode = _checked(columns, spec), columns.get("episode", [None])[-1]
            if before is not None:
                yield before


def _check_groups(file: Any, content: mmap.mmap, names: Iterable[str]) -> None:  # noqa: ANN401 (a ParquetFile)
    """Raise ValueError for a row group that would take more than `MAX_AT_ONCE` bytes."""
    meta, wanted = file.metadata, set(names)
    columns = [n for n in range(meta.num_columns) if meta.schema.column(n).path.partition(".")[0] in wanted]
    for number in range(meta.num_row_groups):
        group, needed = meta.row_group(number), 0
        for column in (group.column(n) for n in columns):
            if column.physical_type not in _BYTES:
                raise ValueError(f"column {column.path_in_schema}: holds no numbers")
            start = column.dictionary_page_offset or column.data_page_offset
            pages = list(page_sizes(content, start, column.total_compressed_size))
            values = max(column.num_values, sum(held for _, held in pages))
            needed += values * _BYTES[column.physical_type] + sum(size for size, _ in pages)
        if needed > MAX_AT_ONCE:
            raise ValueError(f"row group {number} takes {needed:,} bytes; allowed: at most {MAX_AT_ONCE:,}")


def _values(name: str, column: pa.Array, spec: EnvSpec) -> Array:
    """A column's rows, <its dtype>[n] or, of observations, [n, *obs_shape]."""
    import pyarrow as pa  # noqa: PLC0415

    shape = spec.obs_shape if "observations" in name else (spec.num_actions,) if name in MASKS else ()
    rows = len(column)
    if column.null_count:
        raise ValueError(f"column {name}: has rows without a value")
    if shape and not pa.types.is_primitive(column.type):
        any_length = pa.types.is_list(column.type) or pa.types.is_large_list(column.type)
        if not (any_length or pa.types.is_fixed_size_list(column.type)):
            raise ValueError(f"column {name}: {column.type}; allowed: lists of numbers")
        lengths = column.value_lengths() if any_length else None
        held = {column.type.list_size} if lengths is None else {*lengths.unique().to_pylist()}
        if held != {math.prod(shape)}:
            of = "a mask" if name in MASKS else "an observation"
            raise ValueError(f"column {name}: rows of {min(held)} values; {of} of {spec.env_id} has {shape}")
        column = column.flatten()
        if column.null_count:
            raise ValueError(f"column {name}: has rows without a value")
    if not pa.types.is_primitive(column.type) or pa.types.is_temporal(column.type):
        raise ValueError(f"column {name}: {column.type}; allowed: numbers")
    array: Array = column.to_numpy(zero_copy_only=False)
    return array.reshape(rows, *shape)


def _of_minari(folder: Path, spec: EnvSpec) -> Iterator[Rows]:
    import h5py  # noqa: PLC0415 (an extra)

    if spec.masks:
        raise ValueError(f"Minari data sets have no action masks, and {spec.env_id} has; Parquet files may have them")
    first, jpeg = _described(folder)
    with h5py.File(folder / MINARI, "r") as file:
        found = [(int(match[1]), name) for name in file if (match := _EPISODE.fullmatch(name))]
        for _, name in sorted(found):
            episode = _within(h5py, file, name, h5py.Group)
            steps = _within(h5py, episode, "rewards", h5py.Dataset).shape[0]
            shapes = {"observations": (steps + 1, *spec.obs_shape)}
            arrays = {}
            for key in ("observations", "actions", "rewards", "terminations", "truncations"):
                arrays[key] = array = _within(h5py, episode, key, h5py.Dataset)
                expected = shapes.get(key, (steps,))
                if array.shape != expected or array.dtype.kind not in "biuf":
                    hint = "; pictures as JPEG are not read" if jpeg and len(spec.frame_shape) > 1 else ""
                    raise ValueError(f"{name}/{key}: {array.dtype} {array.shape}; {spec.env_id}: {expected}{hint}")
            for start in range(0, steps, ROWS):
                rows = slice(start, min(start + ROWS, steps))
                obs = arrays["observations"][rows.start : rows.stop + 1]
                columns = {key: arrays[key][rows] for key in ("actions", "rewards", "terminations", "truncations")}
                columns |= {"observations": obs[:-1], "next_observations": obs[1:]}
                columns["terminated"], columns["truncated"] = columns.pop("terminations"), columns.pop("truncations")
                if first and columns["actions"].dtype.kind in "iu":
                    columns["actions"] = columns["actions"].astype(np.int64) - first
                last = np.arange(rows.start, rows.stop) == steps - 1
                yield _checked({**columns, "last": last}, spec)


def _described(folder: Path) -> tuple[int, bool]:
    """What a Minari data set says of itself: the number of its first action, and whether pictures are JPEG."""
    file = folder / "metadata.json"
    told = json.loads(read_text(file, MAX_SETTINGS)) if file.is_file() else {}
    space = json.loads(told.get("action_space", "{}"))
    if space.get("type", "Discrete") != "Discrete":
        raise ValueError(f"actions of a space {space['type']!r}; allowed: Discrete")
    return int(space.get("start", 0)), bool(told.get("jpeg_encoding", True))


def _within(h5py: Any, group: Any, name: str, kind: type) -> Any:  # noqa: ANN401 (h5py's classes)
    """What lies in a group under a name, in the same file; raises ValueError."""
    place = f"{group.name.strip('/')}/{name}".strip("/")
    if name not in group or not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{place}: missing, or a link")
    found = group[name]
    if not isinstance(found, kind):
        kinds = kind.__name__.lower()
        raise ValueError(f"{place}: no {kinds}; Dict and Tuple spaces are not read")  # noqa: TRY004 (of the data)
    if isinstance(found, h5py.Dataset):
        if found.is_virtual or found.external:
            raise ValueError(f"{place}: lies in other files")
        if not found.shape or math.prod(found.chunks or ()) * found.dtype.itemsize > MAX_AT_ONCE:
            raise ValueError(f"{place}: shape {found.shape}, chunks {found.chunks}; too large to read")
    return found


def _checked(columns: Mapping[str, Array], spec: EnvSpec) -> Rows:
    """Rows with the dtypes of a table; raises ValueError where a value would be another one."""
    actions, span = columns["actions"], columns.get("span", np.ones(len(columns["actions"]), np.uint8))
    for name, array, most in (("actions", actions, spec.num_actions - 1), ("span", span, MAX_N_STEP)):
        least = int(name == "span")
        if array.dtype.kind not in "iu" or (len(array) and not (array.min() >= least and array.max() <= most)):
            held = f"{array.min()} to {array.max()}" if array.dtype.kind in "iu" else str(array.dtype)
            raise ValueError(f"{name}: {held}; allowed: integers from {least} to {most}")
    terminated = _as("terminated", columns["terminated"], np.bool_)
    ends = terminated | _as("truncated", columns.get("truncated", np.zeros_like(terminated)), np.bool_)
    if (episode := columns.get("episode")) is not None:
        ends[:-1] |= episode[1:] != episode[:-1]
    return Rows(
        _as("observations", columns["observations"], spec.frame_dtype),
        _as("next_observations", columns["next_observations"], spec.frame_dtype),
        actions.astype(np.int32),
        _as("rewards", columns["rewards"], np.float32),
        terminated,
        ends | columns.get("last", np.zeros_like(ends)),
        span.astype(np.uint8),
        *(_as(name, columns[name], np.bool_) for name in MASKS if name in columns),
    )


def _as(name: str, array: Array, dtype: Any) -> Array:  # noqa: ANN401 (whatever numpy takes as one)
    if not np.can_cast(array.dtype, dtype, "same_kind"):
        raise ValueError(f"{name}: {array.dtype}; allowed: {np.dtype(dtype)}")
    with np.errstate(over="ignore"):  # what is not finite is refused with its place
        return np.ascontiguousarray(array, dtype)
