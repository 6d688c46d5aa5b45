"""Replays a journal on a core: after a kill -9, and to re-execute a run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from common.errors import RunError
from common.messaging import wire
from common.messaging.messages.insert import SegmentReader
from common.messaging.messages.sample import DrawRequest
from common.process.files import truncate
from replay.core import ReplayCore
from replay.persistence.journal import (
    DRAW,
    LIMITER,
    SEGMENT,
    TornFile,
    journal_files,
    read_draw,
    read_file,
    read_limiter,
)
from replay.table.table import PinnedBatch


def recover(core: ReplayCore, folder: Path, first: int, run_id: int) -> tuple[int, str]:
    """Replay the journal on a core from file `first` to its end; return the next file's number, and a description.

    A file that ends with a torn record, as a kill leaves it, is cut there.

    Raises:
        RunError: the journal belongs to another run, files are missing or too short, or the replay deviates from the
            record.
    """
    before, draws = core.table.inserted, 0
    numbers = following_files(folder, first)
    for number in numbers:
        try:
            for _ in replay_file(core, folder, number, run_id):
                draws += 1
        except TornFile as torn:
            if number != numbers[-1]:
                raise
            truncate(torn.path, torn.end)
    taken = core.table.inserted - before
    return first + len(numbers), f"{taken:,} transitions and {draws:,} batches from the journal"


def replay_file(core: ReplayCore, folder: Path, number: int, run_id: int) -> Iterator[tuple[DrawRequest, PinnedBatch]]:
    """Replay one file; yields every draw, which must be read before the next one. Raises as `recover`."""
    read = SegmentReader(core.table.spec)
    for kind, payload in read_file(folder, number, run_id):
        if kind == SEGMENT:
            core.apply_insert(read(wire.decode(payload, wire.ON_DISK)))
        elif kind == DRAW:
            request, ids = read_draw(payload)
            batch, _ = core.apply_draw(request)
            if not np.array_equal(batch.columns["ids"], ids):
                raise RunError(f"{folder}: file {number}, batch {request.sequence}: other transitions than recorded")
            yield request, batch
        elif kind == LIMITER:
            core.restore_limiter(read_limiter(payload))


def following_files(folder: Path, first: int) -> list[int]:
    """Numbers of a journal's files from `first` on; raises RunError if one is missing."""
    numbers = [number for number in journal_files(folder) if number >= first]
    if numbers != list(range(first, first + len(numbers))):
        raise RunError(f"{folder}: has files {numbers}, should have every one from {first} on")
    return numbers
