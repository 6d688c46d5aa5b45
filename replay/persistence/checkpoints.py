"""The replay service's parts of a run's checkpoints: writes them during operation, restores them, deletes old ones."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path

from coop.common.errors import RunError
from coop.common.messaging.conversation import Conversation, Task, start
from coop.common.process.files import aside_folder, move_aside
from coop.records.checkpoints import (
    DONE,
    FOLDER,
    LEARNER,
    REPLAY,
    Damaged,
    check_part,
    checkpoint_numbers,
    checkpoint_path,
    read_manifest,
    remove,
    settle,
)
from coop.replay.core import ReplayCore
from coop.replay.persistence.journal import Journal, journal_names
from coop.replay.persistence.storage import Mark, load_snapshot, save_snapshot


class ReplayCheckpoints:
    """Parts of checkpoints under `checkpoints/` of a folder, written one at a time in a separate thread."""

    def __init__(
        self,
        folder: Path,
        run_id: int,
        journal: Journal | None = None,
        start: Callable[[str, Conversation[None]], Task] = start,
    ) -> None:
        self._folder = folder
        self._run_id = run_id
        self._journal = journal
        self._start = start
        self._writer: Task | None = None
        self._number = -1
        self._asked = -1, -1  # the learner that has asked for it, and which of its requests that was
        self._on_disk = False
        self._problem = ""

    def begin(
        self, core: ReplayCore, lock: threading.Condition, number: int, keep: list[int], asked: tuple[int, int]
    ) -> None:
        """Freeze the core's present state and begin to write it; return before it is written.

        keep: the older checkpoints still needed. asked: the learner that asks, and which of its requests this is; a
        repeated one changes nothing.

        Raises:
            RunError: another checkpoint is being written, the request is older than the last one, or there is no space
                for the journal.
        """
        learner, last = self._asked
        if asked == self._asked:
            return
        if asked[0] == learner and asked[1] < last:
            raise RunError(f"checkpoint {number} was asked for before checkpoint {self._number}")
        if self._is_writing():
            if number == self._number:
                return
            raise RunError(f"checkpoint {number}: checkpoint {self._number} is still being written")
        path = part_path(self._folder, number)
        with lock:
            try:
                mark = Mark(self._run_id, number, 0 if self._journal is None else self._journal.roll())
            except OSError as error:
                raise RunError(f"the journal can't be written: {error.strerror or error}") from error
            snapshot = core.snapshot(number, keep)

        def write() -> Conversation[None]:
            try:
                yield 0.0
                if self._journal is not None:
                    self._journal.sync(mark.journal)
                save_snapshot(snapshot, lock, path, mark)
                self._drop({number, *keep}, covered=keep)
                self._on_disk = True
            except OSError as error:
                self._problem = f"{path}: {error.strerror or error}"
            except Exception as error:  # whatever it is, the part must not count as written
                self._problem = f"{path}: {type(error).__name__}: {error}"
                raise
            finally:
                with lock:
                    lock.notify_all()

        self._number, self._on_disk, self._problem, self._asked = number, False, "", asked
        self._writer = self._start(f"checkpoint {number}", write())

    def written(self, number: int) -> bool:
        """Whether the part of checkpoint `number` is on disk (False: it is being written).

        Raises:
            RunError: it was not begun or could not be written.
        """
        if number != self._number or self._writer is None:
            raise RunError(f"checkpoint {number} was not begun")
        if self._is_writing():
            return False
        if not self._on_disk:
            raise RunError(self._problem or f"{part_path(self._folder, number)}: the writer ended without a result")
        return True

    def _is_writing(self) -> bool:
        return self._writer is not None and self._writer.is_alive() and not (self._on_disk or self._problem)

    def intact(self) -> list[int]:
        """Numbers of the intact parts, in ascending order."""
        return [number for number in part_numbers(self._folder) if not self._problem_of(number)]

    def passed_over(self) -> str:
        """What is wrong with the parts that are not intact, in one line; empty if nothing is."""
        problems = ((number, self._problem_of(number)) for number in part_numbers(self._folder))
        return "; ".join(f"checkpoint {number}: {problem}" for number, problem in problems if problem)

    def _problem_of(self, number: int) -> str:
        try:
            check_part(part_path(self._folder, number), number, None)
        except Damaged as damaged:
            return f"{REPLAY}/: {damaged}"
        return ""

    def restore(self, core: ReplayCore, number: int) -> tuple[int, str]:
        """Restore a new core from the newest intact part up to checkpoint `number`, if there is one.

        Returns:
            The first file of the journal that continues it, and a description of the part.

        Raises:
            RunError: it belongs to another run.
            UsageError: it belongs to a table with other settings.
        """
        torn = ""
        for found in reversed([n for n in part_numbers(self._folder) if n <= number]):
            try:
                mark = load_snapshot(core, part_path(self._folder, found), self._run_id, found)
            except Damaged as error:
                torn += f"passed over {part_path(self._folder, found)}, {error}; "
                continue
            text = f"restored checkpoint {found}: {core.table.inserted:,} transitions, {core.drawn:,} batches"
            return mark.journal, torn + text
        return 1, f"{torn}no checkpoint to restore"

    def go_back(self, number: int, *, anew: bool) -> str:
        """Move aside what is younger than checkpoint `number`, and everything if the run starts over.

        A learner that shares the folder moves whole checkpoints. Returns where it is now; empty if there was nothing.

        Raises OSError.
        """
        younger = [each for each in part_numbers(self._folder) if anew or (number and each > number)]
        names = [f"{FOLDER}/{each}/{REPLAY}" for each in younger if not self._is_shared(each)]
        names += journal_names(self._folder) if anew else []
        if not names:
            return ""
        to = aside_folder(self._folder)
        move_aside(self._folder, names, to)
        for each in younger:
            with contextlib.suppress(OSError):  # something else is there
                checkpoint_path(self._folder, each).rmdir()
        return f"what {'was there' if anew else 'is younger'} is in {to}"

    def _is_shared(self, number: int) -> bool:
        return any((checkpoint_path(self._folder, number) / name).exists() for name in (LEARNER, DONE))

    def close(self) -> None:
        """Wait for the part being written, and end the journal."""
        if self._writer is not None:
            self._writer.join()
        if self._journal is not None:
            with contextlib.suppress(OSError):  # the next process reads it like one that was killed
                self._journal.close()

    def _drop(self, keep: set[int], covered: list[int]) -> None:
        """Delete the parts not in `keep`, and the journal's files that no finished checkpoint needs.

        covered: numbers of the checkpoints that the learner has finished. If there are none, recovery begins with the
        journal's first file.
        """
        for number in set(part_numbers(self._folder)) - keep:
            self._remove(number)
        if self._journal is not None and covered:
            marks = []
            for number in part_numbers(self._folder):
                with contextlib.suppress(Damaged):
                    marks.append(read_manifest(part_path(self._folder, number)).journal)
            self._journal.drop(min(marks))

    def _remove(self, number: int) -> None:
        path = part_path(self._folder, number)
        remove(path)
        with contextlib.suppress(OSError):  # the folder may contain the learner's part
            path.parent.rmdir()


def settle_parts(folder: Path) -> None:
    """Complete what a kill has left half done, before anything is read; raises OSError."""
    for number in checkpoint_numbers(folder):
        settle(part_path(folder, number), number)


def part_path(folder: Path, number: int) -> Path:
    """Path of the replay service's part of a checkpoint in a folder."""
    return checkpoint_path(folder, number) / REPLAY


def part_numbers(folder: Path) -> list[int]:
    """Numbers of the checkpoints of which a folder holds parts, in ascending order."""
    return checkpoint_numbers(folder, REPLAY)
