"""The replay service's part of an epoch: `replay/` with one `.npy` file per array, and `state.msgpack`.

The folder gets its name once everything in it is on the disk. `state.msgpack` holds the sizes and checksums of the
other files and begins with its own checksum.
"""

from __future__ import annotations

import io
import shutil
import threading
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import msgspec
import numpy as np

from common.errors import BadMessage
from common.messaging import wire
from common.messaging.messages.sample import BatchReader, EpisodeRecord, encode_batch
from common.messaging.wire import Message
from common.process.files import PIECE, SyncedFile, measure, sync_folder, write_atomic
from common.process.run_ids import check_owner
from common.process.untrusted import load_array
from common.types import Array, EpisodeEnd
from replay.core import CoreSnapshot, ReplayCore

FRAMES_AT_ONCE = 256
STATE = "state.msgpack"


class TornSnapshot(Exception):
    """A folder is not an intact snapshot; the message says why."""


class Mark(NamedTuple):
    """The id of a snapshot's run, and the first file of the journal that continues the snapshot."""

    run_id: int
    journal: int


def save_snapshot(snapshot: CoreSnapshot, lock: threading.Condition, path: Path, mark: Mark) -> None:
    """Write a core's snapshot to the folder `path`, completely or not at all, and release it.

    lock: held only for short times, to read frames of the table, which stays in use.

    Raises:
        OSError: the folder cannot be written.
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
        "books": snapshot.state,  # a name of the file format
        "episodes": msgspec.to_builtins(snapshot.episodes),
        "table": meta,
        "replies": replies,
        "mark": mark,
        "files": files,
    }
    packed = msgpack.packb(state)
    write_atomic(part / STATE, zlib.crc32(packed).to_bytes(4, "little") + packed)


def load_snapshot(core: ReplayCore, path: Path, run_id: int) -> Mark:
    """Restore a new core from the snapshot in `path`.

    Raises:
        TornSnapshot: the folder is not an intact snapshot; the core is unchanged.
        RunError: the snapshot belongs to another run.
        UsageError: the snapshot's table has other settings.
    """
    state = _read_state(path / STATE)
    check_owner(path, state["mark"][0], run_id)
    arrays = {name: _read_array(path / f"{name}.npy", tuple(written)) for name, written in state["files"].items()}
    read = BatchReader(core.table.spec)
    try:
        replies = [read(_reply(payload)) for payload in state["replies"]]
    except BadMessage as error:
        raise TornSnapshot(f"{path / STATE}: {error}") from error
    listed = state["episodes"] if "episodes" in state else state["books"]["episodes"]  # where older versions saved them
    episodes = [EpisodeRecord(step, actor, stream, EpisodeEnd(*end)) for step, actor, stream, end in listed]
    core.restore(state["books"], episodes, state["table"], arrays, replies)
    return Mark(*state["mark"])


def _reply(payload: bytes) -> Message:
    """Decode the answer to a draw; before protocol 4 it did not count terminal transitions."""
    message = wire.decode(payload, wire.ON_DISK)
    return replace(message, fields={"terminal": 0, **message.fields})


def read_mark(path: Path) -> Mark | None:
    """Read the mark of the snapshot in `path`; None if it is torn."""
    try:
        return Mark(*_read_state(path / STATE)["mark"])
    except TornSnapshot:
        return None


def is_intact(path: Path) -> bool:
    """Whether the snapshot in `path` is intact; reads all of it."""
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
    """Read the array of an intact file; a large one stays on disk, because the table copies it."""
    try:
        found = measure(path)
    except OSError as error:
        raise TornSnapshot(f"{path}: {error.strerror or error}") from error
    if found != written:
        raise TornSnapshot(f"{path}: size and checksum {found} instead of {written}")
    try:
        return load_array(path, PIECE)
    except (OSError, ValueError) as error:
        raise TornSnapshot(f"{path}: {error}") from error


def _header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    file = io.BytesIO()
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()
