"""What bare Zenoh's server and client do for each batch: copy its frames, or make a draw's calls of numpy as well."""

from __future__ import annotations

from collections.abc import Callable
from itertools import accumulate, cycle
from typing import Any

import msgspec
import numpy as np
from made_up import ATARI
from service_work import BATCH, CAPACITY

FRAMES = BATCH * (ATARI.stack + 1)  # of a batch without repeats
FRAME_BYTES = 84 * 84
START = 1 << 13  # of the frames in a batch that was drawn; its header and columns lie before them

Ring = np.ndarray[Any, np.dtype[np.uint8]]  # [CAPACITY, FRAME_BYTES]
Answer = Callable[[bytes], bytearray]
Read = Callable[[bytes], object]

COLUMNS = {
    "obs_index": np.dtype((np.int32, ATARI.stack)),
    "next_index": np.dtype((np.int32, ATARI.stack)),
    "ids": np.dtype(np.int64),
    "param_version": np.dtype(np.int64),
    "actions": np.dtype(np.int32),
    "rewards": np.dtype(np.float32),
    "reuse": np.dtype(np.int32),
    "terminated": np.dtype(np.bool_),
    "span": np.dtype(np.uint8),
}
# (lowest, highest) of the columns whose values a client must check before it uses them.
LIMITS = {
    "obs_index": (0, FRAMES),
    "next_index": (0, FRAMES),
    "param_version": (0, 1 << 40),
    "actions": (0, 18),
    "rewards": (-1e6, 1e6),
    "terminated": (0, 1),
    "span": (1, 100),
}
WORD = 8  # bytes of the header's length, with which a batch that was drawn begins
_OFFSETS = list(accumulate((BATCH * kind.itemsize for kind in COLUMNS.values()), initial=WORD))
PLACES = [(name, kind, offset) for (name, kind), offset in zip(COLUMNS.items(), _OFFSETS, strict=False)]
HEADER = _OFFSETS[-1]  # behind the columns
_pack, _unpack = msgspec.msgpack.Encoder().encode, msgspec.msgpack.Decoder().decode
REQUEST = _pack({"incarnation": 1 << 62, "sequence": 10**6, "base": 10**6, "batch_size": BATCH, "episodes": 0})


def copies(ring: Ring) -> Answer:
    """Gather the frames of batches that were drawn before."""
    payload = bytearray(FRAMES * FRAME_BYTES)
    out = np.frombuffer(payload, np.uint8).reshape(FRAMES, FRAME_BYTES)
    starts = np.random.default_rng(0).integers(0, CAPACITY - ATARI.stack, (1000, BATCH, 1))
    picks = cycle((starts + np.arange(ATARI.stack + 1)).reshape(1000, -1))

    def answer(_: bytes) -> bytearray:
        np.take(ring, next(picks), axis=0, out=out, mode="clip")  # mode: without it numpy first gathers into a buffer
        return payload

    return answer


def read_copies(raw: bytes) -> object:
    """The frames, uint8 [FRAMES, FRAME_BYTES]."""
    return np.frombuffer(raw, np.uint8).reshape(FRAMES, FRAME_BYTES)


def draws(ring: Ring) -> Answer:
    """Draw: random rows, each distinct frame once, the columns, a header; nothing is checked, locked or remembered."""
    rng = np.random.default_rng(0)
    frames = ring.reshape(-1).view(np.dtype((np.void, FRAME_BYTES)))
    window = np.arange(ATARI.stack)
    starts = np.arange(CAPACITY)[:, None] % (CAPACITY - ATARI.stack)
    slots = np.concatenate((starts + window, starts + window + 1), axis=1).astype(np.int32)
    mark = np.zeros(CAPACITY, np.int32)
    stored = {name: np.ones(CAPACITY, kind) for name, kind in COLUMNS.items() if kind.ndim == 0 and name != "ids"}
    payload = bytearray(START + FRAMES * FRAME_BYTES)
    whole = memoryview(payload)
    out = np.frombuffer(payload, frames.dtype, FRAMES, START)

    def answer(request: bytes) -> bytearray:
        asked = _unpack(request)
        rows = rng.integers(0, CAPACITY, BATCH)
        flat = slots.take(rows, axis=0).ravel()
        order = np.arange(len(flat), dtype=np.int32)
        mark[flat] = order  # the last of equal ones wins
        distinct = flat[mark[flat] == order]
        mark[distinct] = order[: len(distinct)]
        index = mark[flat].reshape(BATCH, -1)
        stored["reuse"][rows] += 1
        columns = {name: column[rows] for name, column in stored.items()}
        columns |= {"obs_index": index[:, : ATARI.stack], "next_index": index[:, ATARI.stack :], "ids": rows}
        head = _pack({"sequence": asked["sequence"], "frames": len(distinct)})
        parts = [len(head).to_bytes(WORD, "little"), *(columns[name].tobytes() for name in COLUMNS), head]
        joined = b"".join(parts)
        whole[: len(joined)] = joined
        frames.take(distinct, out=out[: len(distinct)], mode="clip")
        return payload

    return answer


def read_draws(raw: bytes) -> object:
    """The header's fields and all arrays, by name; the columns' values are checked."""
    length = int.from_bytes(raw[:WORD], "little")
    found = _unpack(raw[HEADER : HEADER + length])
    found["frames"] = np.ndarray((found["frames"], FRAME_BYTES), np.uint8, raw, START)
    for name, kind, offset in PLACES:
        found[name] = np.ndarray(BATCH, kind, raw, offset)
    for name, (low, high) in LIMITS.items():
        values = found[name]
        if not (low <= values.item(values.argmin()) and values.item(values.argmax()) <= high):
            raise ValueError(name)
    return found


WORK = {"copies": (copies, read_copies), "draws": (draws, read_draws)}
