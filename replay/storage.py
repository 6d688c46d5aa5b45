"""The replay service's part of an epoch on disk: `state.msgpack`, and one `.npy` file per array."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

import msgpack
import numpy as np

from replay.core import ReplayCore

FRAMES_AT_ONCE = 256


def save_snapshot(core: ReplayCore, lock: threading.Condition, path: Path) -> None:
    """Write the core's state as of now to the folder `path`, holding `lock` only in short pieces.

    Raises:
        OSError: the folder can't be written; a half-written one may be left, an epoch without DONE is none.
    """
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    with lock:
        books, snapshot = core.books(), core.table.snapshot()
        frames = np.empty(0) if not len(snapshot.frames) else snapshot.frames.read(0, 1)
    try:
        (path / "state.msgpack").write_bytes(msgpack.packb({"books": books, "table": snapshot.meta}))
        for name, array in snapshot.arrays.items():
            np.save(path / f"{name}.npy", array)
        count = len(snapshot.frames)
        header = np.lib.format.header_data_from_array_1_0(frames) | {"shape": (count, *frames.shape[1:])}
        with (path / "frames.npy").open("wb") as out:  # not mapped, which would hold the whole file in memory
            np.lib.format.write_array_header_1_0(out, header)
            for start in range(0, count, FRAMES_AT_ONCE):
                with lock:
                    piece = snapshot.frames.read(start, min(count, start + FRAMES_AT_ONCE))
                out.write(piece.data)
    finally:
        with lock:
            snapshot.frames.release()
