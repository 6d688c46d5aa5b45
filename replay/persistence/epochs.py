"""The replay service's part in the epochs of a run: writes it beside the traffic, finds it again, drops old ones."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

from common.errors import RunError
from replay.core import ReplayCore
from replay.persistence.journal import Journal
from replay.persistence.storage import Mark, TornSnapshot, load_snapshot, read_mark, save_snapshot

PART = "replay"


class ReplayEpochs:
    """Parts of epochs under `checkpoints/` of a folder, written one at a time in a thread of their own."""

    def __init__(self, folder: Path, run_id: int, journal: Journal | None = None) -> None:
        self._folder = folder / "checkpoints"
        self._run_id = run_id
        self._journal = journal
        self._writer: threading.Thread | None = None
        self._number = -1
        self._problem = ""

    def begin(self, core: ReplayCore, lock: threading.Condition, number: int, keep: list[int]) -> None:
        """Freeze the core as it is now and begin to write it; returns before it is written.

        keep: the older epochs that are still needed. Asking again for the one that is being written changes nothing.

        Raises:
            RunError: another epoch is being written, or there is no space for the journal.
        """
        if self._writer is not None and self._writer.is_alive():
            if number == self._number:
                return
            raise RunError(f"epoch {number}: epoch {self._number} is still being written")
        path = self._folder / str(number) / PART
        with lock:
            try:
                mark = Mark(self._run_id, 0 if self._journal is None else self._journal.roll())
            except OSError as error:
                raise RunError(f"the journal can't be written: {error.strerror or error}") from error
            snapshot = core.snapshot(number)

        def write() -> None:
            try:
                save_snapshot(snapshot, lock, path, mark)
                self._drop({number, *keep})
            except OSError as error:
                self._problem = f"{path}: {error.strerror or error}"

        self._number, self._problem = number, ""
        self._writer = threading.Thread(target=write, name=f"epoch {number}")
        self._writer.start()

    def written(self, number: int, seconds: float) -> bool:
        """Wait up to `seconds`; True if the part of epoch `number` is on disk, False if it is being written.

        Raises:
            RunError: it was not begun or could not be written.
        """
        if number != self._number or self._writer is None:
            raise RunError(f"epoch {number} was not begun")
        self._writer.join(seconds)
        if self._writer.is_alive():
            return False
        if self._problem:
            raise RunError(self._problem)
        return True

    def restore(self, core: ReplayCore, number: int) -> tuple[int, str]:
        """Let a new core go on from the newest whole part up to epoch `number`, if there is one.

        Returns:
            The first file of the journal that continues it, and what was found, in words.

        Raises:
            UsageError: it belongs to another run, or to a table with other settings.
        """
        torn = ""
        for found in sorted((n for n in self._numbers() if n <= number), reverse=True):
            try:
                mark = load_snapshot(core, self._folder / str(found) / PART, self._run_id)
            except TornSnapshot as error:
                torn += f"passed over a torn snapshot, {error}; "
                continue
            text = f"restored epoch {found}: {core.table.inserted:,} transitions, {core.drawn:,} batches"
            return mark.journal, torn + text
        return 1, f"{torn}no epoch to restore"

    def any(self) -> bool:
        """True where the folder holds parts of epochs."""
        return bool(self._numbers())

    def close(self) -> None:
        """Wait for what is being written."""
        if self._writer is not None:
            self._writer.join()

    def _numbers(self) -> list[int]:
        return [int(path.parent.name) for path in self._folder.glob(f"*/{PART}") if path.parent.name.isdigit()]

    def _drop(self, keep: set[int]) -> None:
        """Drop the other parts, and the journal that none of those kept needs."""
        for number in set(self._numbers()) - keep:
            shutil.rmtree(self._folder / str(number) / PART, ignore_errors=True)
        if self._journal is not None:
            marks = (read_mark(self._folder / str(number) / PART) for number in self._numbers())
            self._journal.drop(min(mark.journal for mark in marks if mark is not None))
