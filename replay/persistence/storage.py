"""The replay service's part of a checkpoint: `replay/` with one `.npy` file per array, `state.msgpack`, and `DONE`.

The folder gets its name once everything in it is on the disk. `DONE` seals size and checksum of each file.
"""

from __future__ import annotations

import contextlib
import io
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import msgspec
import numpy as np

from coop.common.errors import BadMessage, CoopError
from coop.common.messaging import wire
from coop.common.messaging.messages.sample import BatchReader, encode_batch
from coop.common.process.files import PIECE, FileDigest, SyncedFile, make_folder
from coop.common.process.untrusted import load_array, read_bytes
from coop.common.transitions import KEPT, columns_of
from coop.common.types import Array, EnvSpec, EpisodeEnd, EpisodeRecord
from coop.records.checkpoints import (
    PART,
    Damaged,
    Manifest,
    check_part,
    exchange,
    read_manifest,
    remove,
    write_manifest,
)
from coop.records.run_ids import check_owner
from coop.replay.core import CoreSnapshot, ReplayCore
from coop.replay.table.numbering import EPISODES
from coop.replay.table.streams import PRELOADED

FRAMES_AT_ONCE = 256
STATE = "state.msgpack"


class SavedTable(NamedTuple):
    """What a checkpoint keeps of a table, for readers.

    columns: by name, in order of insertion, n rows each: what a table keeps of each transition, `obs` and `next_obs`:
        <frame_dtype>[n, *obs_shape], `age`: int64 [n], and `priorities` and `episodes` if the table has them.
    preloaded: transitions that the table began with; those of the run are numbered from there on.
    streams: how many streams of an emulator the run's transitions are of. ends: the environment steps at which
        episodes have ended, as far as the learner may ask for them again.
    """

    spec: EnvSpec
    columns: dict[str, Array]
    preloaded: int
    streams: int
    ends: list[int]


class Mark(NamedTuple):
    """The id of a snapshot's run, the checkpoint's number, and the first file of the journal that continues it."""

    run_id: int
    number: int
    journal: int


def save_snapshot(snapshot: CoreSnapshot, lock: threading.Condition, path: Path, mark: Mark) -> None:
    """Write a core's snapshot to the folder `path`, completely or not at all, and release it.

    lock: held only for short times, to read frames of the table, which stays in use.

    Raises:
        OSError: the folder cannot be written.
    """
    part = path.with_name(path.name + PART)
    try:
        remove(part)
        make_folder(part)
        files = _write(snapshot, lock, part)
        write_manifest(part, Manifest(mark.run_id, mark.number, files, journal=mark.journal))
        exchange(part, path)
    except OSError:
        remove(part)
        raise
    finally:
        with lock:
            snapshot.table.frames.release()


def _write(snapshot: CoreSnapshot, lock: threading.Condition, part: Path) -> dict[str, FileDigest]:
    meta, arrays, frames = snapshot.table
    files: dict[str, FileDigest] = {}
    for name, array in arrays.items():
        with SyncedFile(part / f"{name}.npy") as file:
            file.write(_header(array.dtype, array.shape))
            file.write(np.ascontiguousarray(array).tobytes())
        files[f"{name}.npy"] = file.measured
    with SyncedFile(part / "frames.npy") as file:
        with lock:
            first = frames.read(0, 1)
        file.write(_header(first.dtype, (len(frames), *first.shape[1:])))
        for start in range(0, len(frames), FRAMES_AT_ONCE):
            with lock:
                piece = frames.read(start, min(len(frames), start + FRAMES_AT_ONCE))
            file.write(piece.tobytes())
    files["frames.npy"] = file.measured
    replies = [bytes(encode_batch("", batch.frames, batch.columns(), drawn)) for batch, drawn in snapshot.replies]
    state = {
        "state": snapshot.state,
        "episodes": msgspec.to_builtins(snapshot.episodes),
        "table": meta,
        "replies": replies,
    }
    with SyncedFile(part / STATE) as file:
        file.write(msgpack.packb(state))
    files[STATE] = file.measured
    return files


def load_snapshot(core: ReplayCore, path: Path, run_id: int, number: int) -> Mark:
    """Restore a new core from the snapshot of checkpoint `number` in `path`.

    Raises:
        Damaged: the folder is not an intact snapshot; the core is unchanged.
        RunError: the snapshot belongs to another run.
        UsageError: the snapshot's table has other settings.
    """
    check_owner(path, read_manifest(path).run, run_id)
    read = BatchReader(core.table.spec)
    with _of_a_table():
        manifest, state, arrays = _read(path, number, run_id)
        replies = [read(wire.decode(payload)) for payload in state["replies"]]
        episodes = [
            EpisodeRecord(step, actor, stream, EpisodeEnd(*end)) for step, actor, stream, end in state["episodes"]
        ]
        core.restore(state["state"], episodes, state["table"], arrays, replies)
    return Mark(manifest.run, manifest.number, manifest.journal)


def read_table(path: Path, number: int) -> SavedTable:
    """Read the table of a snapshot of checkpoint `number`; raises Damaged if the folder is not an intact snapshot."""
    with _of_a_table():
        _, state, arrays = _read(path, number, None)
        meta = state["table"]
        env_id, frame_shape, *rest = meta["settings"]["spec"]
        spec = EnvSpec(env_id, tuple(frame_shape), *rest)
        order = np.argsort(arrays["ids"])
        names = [
            name
            for name in (*columns_of(KEPT, spec), "priorities", EPISODES)
            if len(arrays.get(name, ())) == len(order)
        ]
        found = {name: arrays[name][order] for name in names}
        slots, frames = arrays["slots"][order], arrays["frames"]  # mapped: each is read from the disk as it is copied
        for name, index in (("obs", slots[:, : spec.stack]), ("next_obs", slots[:, spec.stack :])):
            found[name] = frames[index].reshape(-1, *spec.obs_shape)
        preloaded = int(meta["preloaded"][0])
        found["age"] = preloaded + meta["inserted"] - 1 - found["ids"]
        streams = sum(1 for _, stream, *_ in meta["streams"] if stream != PRELOADED)
        return SavedTable(spec, found, preloaded, streams, [int(step) for step, *_ in state["episodes"]])


def _read(path: Path, number: int, run_id: int | None) -> tuple[Manifest, dict[str, Any], dict[str, Array]]:
    """Read a snapshot after a check of all its bytes: what seals it, its state, and its arrays."""
    manifest = check_part(path, number, run_id)
    state = msgpack.unpackb(read_bytes(path / STATE), strict_map_key=False)
    names = [name for name in manifest.files if name != STATE]
    return manifest, state, {name.removesuffix(".npy"): _read_array(path / name) for name in names}


@contextlib.contextmanager
def _of_a_table() -> Iterator[None]:
    """Raise Damaged in place of what fails because files, though sealed, are not those of a table."""
    try:
        yield
    except BadMessage as error:
        raise Damaged(f"{STATE}: {error}") from error
    except CoopError:
        raise
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:  # sealed, so not by chance
        raise Damaged(f"{STATE}: not a table of this run: {error!r}") from error


def _read_array(path: Path) -> Array:
    """Read the array of an intact file; a large one stays on disk, because the table copies it."""
    return load_array(path, PIECE)


def _header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    file = io.BytesIO()
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()
