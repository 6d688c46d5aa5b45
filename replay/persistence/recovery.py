"""Replays a journal on a core: after a kill -9, and to re-execute a run.

What can't be read is named and counted as lost, and does not end the reading of what follows it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from coop.common.errors import RunError
from coop.common.messaging import wire
from coop.common.messaging.messages.insert import SegmentReader
from coop.common.transitions import DrawRequest
from coop.replay.core import ReplayCore
from coop.replay.persistence.journal import (
    DRAW,
    END,
    LIMITER,
    SEGMENT,
    Lost,
    journal_files,
    read_draw,
    read_file,
    read_limiter,
)
from coop.replay.table.table import PinnedBatch


def recover(core: ReplayCore, folder: Path, first: int, run_id: int, *, sync: bool = False) -> tuple[int, list[str]]:
    """Replay the journal on a core from file `first` to its end; return the next file's number, and lines to say.

    sync: what was acknowledged had been flushed to the disk. So what can't be read at the journal's end is what a
    machine's death leaves, and its actors send it again; if not, their next segments tell (`ReplayCore.lost`).

    Raises:
        RunError: the journal belongs to another run, or the replay deviates from an undamaged record.
    """
    before, draws = core.table.inserted, 0
    replaying = Replaying(core, folder, run_id)
    numbers = [number for number in journal_files(folder) if number >= first]
    for _ in replaying.draws(first, numbers):
        draws += 1
    lost = replaying.transitions_lost - (replaying.behind if sync else 0)
    core.damaged += lost
    taken = f"{core.table.inserted - before:,} transitions and {draws:,} batches from the journal"
    if numbers and not replaying.ended:
        taken += ", which ends as a kill leaves it"
    notices = [f"{text}; the journal is read on behind it" for text in replaying.lost]
    if lost:
        notices.append(f"the journal lacks {lost:,} transitions that had been acknowledged")
    return max([first, *(number + 1 for number in numbers)]), [taken, *notices]


class Replaying:
    """Replays files of a journal on a core.

    lost: what could not be read, in words. transitions_lost: accepted transitions among it; behind: of these, those
    behind the last whole record of their file. ended: the last file read was closed properly.
    """

    def __init__(self, core: ReplayCore, folder: Path, run_id: int) -> None:
        self.lost: list[str] = []
        self.transitions_lost = self.behind = 0
        self.ended = True
        self._core = core
        self._folder = folder
        self._run_id = run_id
        self._accepted = core.table.inserted  # as the journal counts

    def draws(self, first: int, numbers: list[int]) -> Iterator[tuple[DrawRequest, PinnedBatch]]:
        """Replay files `numbers`, which should follow `first` without a gap.

        Yields every draw, which must be read before the next one. Raises as `recover`.
        """
        if first > 1 and not numbers:  # a checkpoint has begun that file
            self.lost.append(f"{self._folder}: file {first} is missing, and so is all that followed")
        for expected, number in zip([first, *(each + 1 for each in numbers)], numbers, strict=False):
            if number != expected:
                missing = f"file {expected} is" if number == expected + 1 else f"files {expected} to {number - 1} are"
                self.lost.append(f"{self._folder}: {missing} missing")
            yield from self._file(number)

    def _file(self, number: int) -> Iterator[tuple[DrawRequest, PinnedBatch]]:
        core, read = self._core, SegmentReader(self._core.table.spec)
        self.ended, behind = False, 0
        for entry in read_file(self._folder, number, self._run_id):
            if isinstance(entry, Lost):
                self.lost.append(entry.text)
                if entry.accepted is not None:
                    behind += self._count(entry.accepted, number)
                continue
            kind, payload, accepted = entry
            if kind == SEGMENT:
                segment = read(wire.decode(payload))
                self._count(accepted - segment.steps, number)
                behind = 0
                core.apply_insert(segment)
                self._accepted = accepted
                continue
            self._count(accepted, number)
            behind = 0
            if kind == DRAW:
                request, ids = read_draw(payload)
                if self.lost and len(core.table) < request.batch_size:
                    core.drawn = max(core.drawn, request.sequence + 1)  # of transitions that are lost
                    continue
                batch, _ = core.apply_draw(request)
                if not self.lost and not np.array_equal(batch.columns["ids"], ids):
                    text = f"{self._folder}: file {number}, batch {request.sequence}: other transitions than recorded"
                    raise RunError(text)
                yield request, batch
            elif kind == LIMITER:
                core.restore_limiter(read_limiter(payload))
            self.ended = kind == END
        self.behind += behind

    def _count(self, accepted: int, number: int) -> int:
        """Count what is lost before a record of file `number` at which the run had accepted so many transitions."""
        lost = max(0, accepted - self._accepted)
        if lost and not self.lost:  # the file before it ends whole, but earlier than it did
            self.lost.append(f"{self._folder}: {lost:,} transitions before file {number} are missing")
            self.behind += lost
        self.transitions_lost += lost
        self._accepted = accepted
        return lost
