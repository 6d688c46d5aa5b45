"""The replay service's parts of a run's epochs: writes them during operation, restores them, deletes old ones."""

from __future__ import annotations

import contextlib
import shutil
import threading
from pathlib import Path

from common.errors import RunError
from replay.core import ReplayCore
from replay.persistence.journal import Journal
from replay.persistence.storage import Mark, TornSnapshot, is_intact, load_snapshot, read_mark, save_snapshot

PART = "replay"


class ReplayEpochs:
    """Parts of epochs under `checkpoints/` of a folder, written one at a time in a separate thread."""

    def __init__(self, folder: Path, run_id: int, journal: Journal | None = None) -> None:
        self._folder = folder
        self._run_id = run_id
        self._journal = journal
        self._writer: threading.Thread | None = None
        self._number = -1
        self._on_disk = False
        self._problem = ""

    def begin(self, core: ReplayCore, lock: threading.Condition, number: int, keep: list[int]) -> None:
        """Freeze the core's present state and begin to write it; return before it is written.

        keep: the older epochs that are still needed. A repeated call for the epoch being written changes nothing.

        Raises:
            RunError: another epoch is being written, or there is no space for the journal.
        """
        if self._writer is not None and self._writer.is_alive():
            if number == self._number:
                return
            raise RunError(f"epoch {number}: epoch {self._number} is still being written")
        path = part_path(self._folder, number)
        with lock:
            try:
                mark = Mark(self._run_id, 0 if self._journal is None else self._journal.roll())
            except OSError as error:
                raise RunError(f"the journal can't be written: {error.strerror or error}") from error
            snapshot = core.snapshot(number, keep)

        def write() -> None:
            try:
                save_snapshot(snapshot, lock, path, mark)
                self._drop({number, *keep}, covered=keep)
                self._on_disk = True
            except OSError as error:
                self._problem = f"{path}: {error.strerror or error}"
            except Exception as error:  # whatever it is, the part must not count as written
                self._problem = f"{path}: {type(error).__name__}: {error}"
                raise

        self._number, self._on_disk, self._problem = number, False, ""
        self._writer = threading.Thread(target=write, name=f"epoch {number}")
        self._writer.start()

    def written(self, number: int, seconds: float) -> bool:
        """Wait up to `seconds`; return whether the part of epoch `number` is on disk (False: it is being written).

        Raises:
            RunError: it was not begun or could not be written.
        """
        if number != self._number or self._writer is None:
            raise RunError(f"epoch {number} was not begun")
        self._writer.join(seconds)
        if self._writer.is_alive():
            return False
        if not self._on_disk:
            raise RunError(self._problem or f"{part_path(self._folder, number)}: the writer ended without a result")
        return True

    def intact(self) -> list[int]:
        """Numbers of the intact parts, in ascending order."""
        return [number for number in part_numbers(self._folder) if is_intact(part_path(self._folder, number))]

    def restore(self, core: ReplayCore, number: int) -> tuple[int, str]:
        """Restore a new core from the newest intact part up to epoch `number`, if there is one.

        Returns:
            The first file of the journal that continues it, and a description of the part.

        Raises:
            RunError: it belongs to another run.
            UsageError: it belongs to a table with other settings.
        """
        torn = ""
        for found in reversed([n for n in part_numbers(self._folder) if n <= number]):
            try:
                mark = load_snapshot(core, part_path(self._folder, found), self._run_id)
            except TornSnapshot as error:
                torn += f"passed over a torn snapshot, {error}; "
                continue
            text = f"restored epoch {found}: {core.table.inserted:,} transitions, {core.drawn:,} batches"
            return mark.journal, torn + text
        return 1, f"{torn}no epoch to restore"

    def clear(self) -> None:
        """Delete every part."""
        for number in part_numbers(self._folder):
            self._remove(number)

    def close(self) -> None:
        """Wait for the part being written."""
        if self._writer is not None:
            self._writer.join()

    def _drop(self, keep: set[int], covered: list[int]) -> None:
        """Delete the parts not in `keep`, and the journal's files that no finished epoch needs.

        covered: numbers of the epochs that the learner has finished. If there are none, recovery begins with the
        journal's first file.
        """
        for number in set(part_numbers(self._folder)) - keep:
            self._remove(number)
        if self._journal is not None and covered:
            marks = (read_mark(part_path(self._folder, number)) for number in part_numbers(self._folder))
            self._journal.drop(min(mark.journal for mark in marks if mark is not None))

    def _remove(self, number: int) -> None:
        path = part_path(self._folder, number)
        shutil.rmtree(path, ignore_errors=True)
        with contextlib.suppress(OSError):  # the folder may contain the learner's part
            path.parent.rmdir()


def part_path(folder: Path, number: int) -> Path:
    """Path of the replay service's part of an epoch in a folder."""
    return folder / "checkpoints" / str(number) / PART


def part_numbers(folder: Path) -> list[int]:
    """Numbers of the epochs of which a folder holds parts, in ascending order."""
    found = (path.parent.name for path in (folder / "checkpoints").glob(f"*/{PART}"))
    return sorted(int(name) for name in found if name.isdigit())
