"""What must hold of checkpoints: those that are sealed are whole, and can be restored."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.simulate.roles import SPEC
from coop.records.checkpoints import DONE, Damaged, check_part, checkpoint_numbers, checkpoint_path, read_manifest
from coop.records.learner_checkpoints import load_learner
from coop.records.run_ids import read_run_id
from coop.replay.core import ReplayCore
from coop.replay.persistence.checkpoints import part_path, settle_parts
from coop.replay.persistence.storage import load_snapshot

if TYPE_CHECKING:
    from benchmarks.simulate.checks import Checks


class Checkpoints:
    """Looks at the checkpoints of a run."""

    def __init__(self, checks: Checks) -> None:
        self._checks = checks
        self._root = checks.cluster.root
        self._run = self._root / "learner" / "run"
        self._sealed: object = None  # the checkpoint that was looked at last

    @property
    def _folders(self) -> list[Path]:
        """Those of the replay services' parts."""
        folders = (self._root / place / "table" for place in ("replay", "elsewhere"))
        return [folder for folder in folders if not self._checks.strangers.foreign_folder(folder)]

    def look_at_parts(self) -> None:
        """The newest sealed checkpoint has a sealed part of the replay service."""
        newest = checkpoint_numbers(self._run, DONE)[-1:]
        parts = [part_path(folder, each) for folder in self._folders for each in newest]
        there = not parts or any((part / DONE).exists() for part in parts)
        self._checks.hold("checkpoint", there, f"{newest} is sealed without the replay service's part")

    def look(self) -> None:
        """The newest checkpoint that is said to be whole must be so."""
        checks, numbers = self._checks, checkpoint_numbers(self._run, DONE)
        if not numbers:
            return
        newest = numbers[-1]
        path = checkpoint_path(self._run, newest)
        sealed = newest, (path / DONE).stat().st_mtime_ns
        if sealed != self._sealed:
            state = load_learner(path)
            checks.hold("checkpoint", state["agent"]["updates"] == newest, f"{newest} holds another number of updates")
        for folder in self._folders:
            self._settle(folder)
            with suppress(Damaged):
                if sealed != self._sealed:
                    self._restore(folder, newest)
                else:
                    check_part(part_path(folder, newest), newest, None)
                self._sealed = sealed
                return
        checks.broken(f"checkpoint: {newest} is sealed, but the replay service has no whole part of it")

    def place_of_part(self) -> str:
        """The machine that holds the replay service's part of the newest checkpoint; empty if none does."""
        newest = checkpoint_numbers(self._run, DONE)[-1:]
        holders = (folder for folder in self._folders for each in newest if part_path(folder, each).exists())
        return next((folder.parent.name for folder in holders), "")

    def _settle(self, folder: Path) -> None:
        """What the next replay service does first: a kill while one part replaces another leaves both, unnamed."""
        world = self._checks.cluster.world
        if any(each.alive and each.state.get("folder") == folder for each in world.processes):
            return
        running, world.running = world.running, None  # no call of a process that its faults count
        try:
            settle_parts(folder)
        finally:
            world.running = running

    def _restore(self, folder: Path, number: int) -> None:
        checks, path = self._checks, part_path(folder, number)
        core = ReplayCore(checks.cluster.config, SPEC)
        mark = load_snapshot(core, path, read_manifest(path).run, number)
        checks.hold("checkpoint", mark.run_id == read_run_id(folder), f"part of {number} is another run's")
        checks.look_at(core, promised=())
        # Where draws may be lost, as in an empty table elsewhere, the learner's next request says how many there were.
        exact = checks.cluster.plan.journal != "off" and not checks.cluster.met["crash"] and not checks.forgiven
        checks.hold("checkpoint", core.drawn >= number or not exact, f"part of {number} has drawn {core.drawn}")
