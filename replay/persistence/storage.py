"""The replay service's part of an epoch on disk: `replay/` with one `.npy` file per array, and `state.msgpack`.

The folder gets its name when everything in it is on the disk. `state.msgpack` holds the size and checksum of the other
files and begins with its own checksum.
"""

from __future__ import annotations

import io
import shutil
import threading
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import msgspec
import numpy as np

from common.errors import BadMessage
from common.messaging import wire
from common.messaging.messages.sample import BatchReader, EpisodeRecord, encode_batch
from common.process.files import PIECE, SyncedFile, measure, sync_folder, write_whole
from common.process.run_ids import check_owner
from common.types import Array, EpisodeEnd
from replay.core import CoreSnapshot, ReplayCore

FRAMES_AT_ONCE = 256
STATE = "state.msgpack"


class TornSnapshot(Exception):
    """A folder that is not a whole snapshot; says what is wrong with it."""


class Mark(NamedTuple):
    """What a snapshot belongs to: the id of its run, and the first file of the journal that continues it."""

    run_id: int
    journal: int


def save_snapshot(snapshot: CoreSnapshot, lock: threading.Condition, path: Path, mark: Mark) -> None:
    """Write a core's snapshot to the folder `path`, whole or not at all, and release it.

    lock: held only in short pieces, to read frames of the table that goes on.

    Raises:
        OSError: the folder can't be written.
    """
    part = path.with_name(path.name + ".part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        _write(snapshot, lock, part, mark)
        shutil.rmtree(path, ignore_errors=True)
        part.replace(path)
        sync_folder(path.parent)
    except OSError:
        shutil.rmtree(part, ignore_errors=True)
        raise
    finally:
        with lock:
            snapshot.table.frames.release()


def _write(snapshot: CoreSnapshot, lock: threading.Condition, part: Path, mark: Mark) -> None:
    meta, arrays, frames = snapshot.table
    files: dict[str, tuple[int, int]] = {}
    for name, array in arrays.items():
        with SyncedFile(part / f"{name}.npy") as file:
            file.write(_header(array.dtype, array.shape))
            file.write(np.ascontiguousarray(array).tobytes())
        files[name] = file.size, file.checksum
    with SyncedFile(part / "frames.npy") as file:
        with lock:
            first = frames.read(0, 1)
        file.write(_header(first.dtype, (len(frames), *first.shape[1:])))
        for start in range(0, len(frames), FRAMES_AT_ONCE):
            with lock:
                piece = frames.read(start, min(len(frames), start + FRAMES_AT_ONCE))
            file.write(piece.tobytes())
    files["frames"] = file.size, file.checksum
    replies = [bytes(encode_batch("", batch.frames, batch.columns(), drawn)) for batch, drawn in snapshot.replies]
    state = {
        "books": snapshot.books,
        "episodes": msgspec.to_builtins(snapshot.episodes),
        "table": meta,
        "replies": replies,
        "mark": mark,
        "files": files,
    }
    packed = msgpack.packb(state)
    write_whole(part / STATE, zlib.crc32(packed).to_bytes(4, "little") + packed)


def load_snapshot(core: ReplayCore, path: Path, run_id: int) -> Mark:
    """Let a new core go on from the snapshot in `path`.

    Raises:
        TornSnapshot: the folder is not a whole snapshot; the core is as before.
        RunError: it is a snapshot of another run.
        UsageError: it is one of a table with other settings.
    """
    state = _read_state(path / STATE)
    check_owner(path, state["mark"][0], run_id)
    arrays = {name: _read_array(path / f"{name}.npy", tuple(written)) for name, written in state["files"].items()}
    read = BatchReader(core.table.spec)
    try:
        replies = [read(wire.decode(payload, wire.ON_DISK)) for payload in state["replies"]]
    except BadMessage as error:
        raise TornSnapshot(f"{path / STATE}: {error}") from error
    listed = state["episodes"] if "episodes" in state else state["books"]["episodes"]  # where older versions have them
    episodes = [EpisodeRecord(step, actor, stream, EpisodeEnd(*end)) for step, actor, stream, end in listed]
    core.restore(state["books"], episodes, state["table"], arrays, replies)
    return Mark(*state["mark"])


def read_mark(path: Path) -> Mark | None:
    """What the snapshot in `path` belongs to; None where it is torn."""
    try:
        return Mark(*_read_state(path / STATE)["mark"])
    except TornSnapshot:
        return None


def is_whole(path: Path) -> bool:
    """True where the snapshot in `path` is as it was written; reads all of it."""
    try:
        state = _read_state(path / STATE)
        return all(measure(path / f"{name}.npy") == tuple(written) for name, written in state["files"].items())
    except (TornSnapshot, OSError):
        return False


def _read_state(path: Path) -> dict[str, Any]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise TornSnapshot(f"{path}: {error.strerror or error}") from error
    if len(content) <= 4 or zlib.crc32(content[4:]) != int.from_bytes(content[:4], "little"):
        raise TornSnapshot(f"{path}: wrong checksum")
    state: dict[str, Any] = msgpack.unpackb(content[4:], strict_map_key=False)
    return state


def _read_array(path: Path, written: tuple[int, int]) -> Array:
    """The array of a file that is as it was written; a large one stays on disk, for the table copies it."""
    try:
        found = measure(path)
    except OSError as error:
        raise TornSnapshot(f"{path}: {error.strerror or error}") from error
    if found != written:
        raise TornSnapshot(f"{path}: size and checksum {found} instead of {written}")
    array: Array = np.load(path, mmap_mode="r" if found[0] > PIECE else None)
    return array


def _header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    file = io.BytesIO()
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()
