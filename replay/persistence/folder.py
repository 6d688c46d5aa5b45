"""A replay service's folder, which belongs to one run and to one process at a time."""

from __future__ import annotations

from pathlib import Path

from coop.common.errors import RunError, UsageError
from coop.records.checkpoints import Damaged, read_manifest
from coop.records.locks import RunLock
from coop.records.run_ids import check_owner, claim, has_run_id, read_run_id
from coop.replay.persistence.checkpoints import part_numbers, part_path, settle_parts
from coop.replay.persistence.journal import journal_files, read_owner


class ReplayFolder:
    """The folder of a replay service's parts of checkpoints and journal; it may also contain the learner's files.

    path, run_id: of the folder, and of the run. journal: the journal's folder.
    """

    def __init__(self, path: Path, run_id: int) -> None:
        self.path = path
        self.run_id = run_id
        self.journal = path / "journal"

    def check(self, *, resume: bool) -> str:
        """Check the folder's run and contents, without writing; return a description of what was found.

        Raises:
            RunError: it belongs to another run.
            UsageError: it holds data of this run, but `resume` is False.
        """
        if has_run_id(self.path):
            check_owner(self.path, read_run_id(self.path), self.run_id)
        files = journal_files(self.journal)
        parts = [part_path(self.path, number) for number in part_numbers(self.path)]
        owned = [(path, owner) for path in parts if (owner := _owner(path)) is not None]
        owned += [(self.journal, owner) for number in files if (owner := read_owner(self.journal, number)) is not None]
        for path, owner in owned:
            check_owner(path, owner, self.run_id)
        if not parts and not files:
            return f"starts: there is no table of this run in {self.path} yet"
        if not owned and not has_run_id(self.path):
            raise RunError(f"{self.path}: holds checkpoints that do not name their run")
        if not resume:
            raise UsageError(f"--run-dir {self.path}: holds a run already; give another, or --resume")
        return f"goes on in {self.path}"

    def lock(self) -> RunLock:
        """Lock the folder, assign it to the run, and complete what a kill has left half done in it.

        Raises:
            RunError: another process uses it, it now belongs to another run, or it cannot be written.
        """
        lock = RunLock(self.path, "coop-replay", ("replay",))
        try:
            claim(self.path, self.run_id)
            settle_parts(self.path)
        except RunError:
            lock.release()
            raise
        except OSError as error:
            lock.release()
            raise RunError(f"{self.path}: {error.strerror or error}") from error
        lock.sign()
        return lock


def _owner(part: Path) -> int | None:
    """The id of the run of a part; None if that can't be read."""
    try:
        return read_manifest(part).run
    except Damaged:
        return None
