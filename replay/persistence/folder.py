"""A replay service's folder: whose it is, and that one process at a time works in it."""

from __future__ import annotations

from pathlib import Path

from common.errors import RunError, UsageError
from common.process.locks import RunLock
from common.process.run_ids import check_owner, claim, has_run_id, read_run_id
from replay.persistence.epochs import part_numbers, part_path
from replay.persistence.journal import journal_files, read_owner
from replay.persistence.storage import read_mark


class ReplayFolder:
    """Where one run's replay service keeps its parts of epochs and its journal; the learner's files may be here too.

    path, run_id: of the folder, and of the run. journal: the journal's folder.
    """

    def __init__(self, path: Path, run_id: int) -> None:
        self.path = path
        self.run_id = run_id
        self.journal = path / "journal"

    def check(self, *, resume: bool) -> str:
        """Look whose the folder is and what it holds, and write nothing; what was found, in words.

        Raises:
            RunError: it is another run's.
            UsageError: a replay service of this run has worked here, and it is not to go on.
        """
        if has_run_id(self.path):
            check_owner(self.path, read_run_id(self.path), self.run_id)
        files = journal_files(self.journal)
        owners = [(part_path(self.path, number), read_mark(part_path(self.path, number))) for number in self._numbers()]
        told = [(path, mark.run_id) for path, mark in owners if mark is not None]
        told += [(self.journal, owner) for number in files if (owner := read_owner(self.journal, number)) is not None]
        for path, owner in told:
            check_owner(path, owner, self.run_id)
        if not owners and not files:
            return f"starts: there is no table of this run in {self.path} yet"
        if not told and not has_run_id(self.path):
            raise RunError(f"{self.path}: holds epochs that do not tell which run they are of")
        if not resume:
            raise UsageError(f"--run-dir {self.path}: holds a run already; give another, or --resume")
        return f"goes on in {self.path}"

    def lock(self) -> RunLock:
        """Lock the folder and make it the run's.

        Raises:
            RunError: another process works in it, it has become another run's, or it can't be written.
        """
        lock = RunLock(self.path, "coop-replay", ("replay",))
        try:
            claim(self.path, self.run_id)
        except RunError:
            lock.release()
            raise
        return lock

    def _numbers(self) -> list[int]:
        return part_numbers(self.path)
