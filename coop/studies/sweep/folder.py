"""A cell's folder: the state of its run, the config that it must hold, and the lock of the process that runs it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from coop.common.errors import RunError, UsageError
from coop.common.numbers import RETURN_WINDOW
from coop.common.process.console import counted, say
from coop.common.process.files import make_folder, write_atomic
from coop.common.process.untrusted import check_links, read_bytes, refuse_links
from coop.common.settings.tables import CONFIG, SEAL, identity, run_config_text, sealed_toml
from coop.records.checkpoints import RECORDS, SWEEP, checked_summary
from coop.records.locks import LockHeld, RunLock
from coop.records.reading import read_csv_tail, read_run_config, run_names
from coop.records.resumption import holds_run, strays
from coop.records.sinks import DEFAULT_LOG
from coop.studies.sweep.grid import Cell, Grid


@dataclass(frozen=True)
class Progress:
    """A run's progress: environment steps at its last episode's end, mean return of the last 100 episodes."""

    step: int
    mean_return: float


@dataclass(frozen=True)
class Ending:
    """How a cell's run ended; why: the reason, unless it is finished.

    A diverged run would diverge again; a lost one, whose worker is gone, can go on elsewhere.
    """

    kind: Literal["finished", "diverged", "failed", "lost"]
    why: str = ""


class CellFolder:
    """One cell's folder within the sweep's."""

    def __init__(self, sweep: Path, cell: Cell, log: str = DEFAULT_LOG) -> None:
        """log: see `--log` of a run."""
        self.cell = cell
        self.log = log
        self.path = sweep / cell.name

    def check(self) -> None:
        """Raise UsageError if the folder holds a run of another config, or a config of the user's, or is a link."""
        refuse_links(self.path)
        check_links(self.path)
        held = self.path / "config.toml"
        if held.exists() and identity(read_run_config(self.path)) != identity(self.cell.config):
            raise UsageError(f"{held}: not the config of this grid's cell; give another --dir")
        if CONFIG in strays(self.path):
            raise UsageError(f"{held}: not written by a sweep, and would be replaced; give another --dir")

    def ending(self) -> Ending | None:
        """How its run ended for good; None if it has to be run or continued."""
        outcome = self.outcome()
        if outcome.startswith("complete"):
            return Ending("finished")
        return Ending("diverged", outcome) if outcome.startswith("diverged") else None

    def outcome(self) -> str:
        """How its run ended, from summary.json; empty if that can't be read, or the records are not those it seals."""
        try:
            return str(checked_summary(self.path).get("exit", ""))
        except RunError:
            return ""  # resuming the run names what is wrong, or writes them again

    def lock(self) -> RunLock | None:
        """The locks of the cell's run; None if another process has them. A child that inherits them keeps them."""
        try:
            return RunLock(self.path, "coop-sweep", ("learner", "replay")).sign()
        except LockHeld:
            return None

    def prepare(self) -> None:
        """Write the config from which the run starts or continues."""
        write_atomic(self.path / "config.toml", run_config_text(self.cell.config).encode())

    def progress(self) -> Progress:
        """Read the progress from the end of episodes.csv; zeros before the first episode's end, or if it is damaged."""
        try:
            rows = read_csv_tail(self.path / RECORDS[0], RETURN_WINDOW)
            if not rows:
                return Progress(0, 0.0)
            return Progress(int(rows[-1]["env_step"]), sum(float(row["return"]) for row in rows) / len(rows))
        except (RunError, ValueError, KeyError):
            return Progress(0, 0.0)  # only for the display: who continues or reports the run names what is damaged


def default_folder(grid: str | Path, quick: bool) -> Path:
    """The folder of a sweep that names none."""
    return Path("runs") / "sweeps" / (Path(grid).stem + ("-quick" if quick else ""))


def claim_folder(grid: Grid, cells: Sequence[CellFolder], folder: Path) -> None:
    """Assign a folder to a sweep, or refuse it before anything runs.

    Raises:
        UsageError: it holds runs of other configs, is a run's or another sweep's, or cannot be written.
    """
    check_no_run(folder, "--dir")
    try:
        make_folder(folder)
        _check_sweep(grid, folder)
        for cell in cells:
            cell.check()
        write_atomic(folder / SWEEP, sealed_toml(grid.to_toml()).encode())
    except OSError as error:
        raise UsageError(f"--dir {folder}: {error.strerror}") from error


def check_no_run(folder: Path, name: str) -> None:
    """Refuse the folder of a run as one for runs; name: of what gave it. Raises UsageError."""
    if holds_run(folder):
        raise UsageError(f"{name} {folder}: the folder of a run; give another one")


def _check_sweep(grid: Grid, folder: Path) -> None:
    """Refuse a folder whose sweep.toml the user wrote, or with runs of which none is a cell of this grid.

    Runs that are none, as of a grid that has shrunk, are named, since reports leave them out. Raises UsageError, and
    OSError.
    """
    path = folder / SWEEP
    if not path.exists():
        return
    refuse_links(path)
    held = read_bytes(path)
    if SEAL.encode() not in held:
        raise UsageError(f"{path}: not written by a sweep, and would be replaced; give another --dir")
    if held == sealed_toml(grid.to_toml()).encode():
        return
    runs, cells = run_names(folder), {choice.name for choice in grid.choices}
    others = [name for name in runs if name not in cells]
    if others and len(others) == len(runs):
        raise UsageError(f"--dir {folder}: holds another sweep, with runs such as {others[0]}; give another --dir")
    if others:
        named = f"{counted(len(others), 'run')}, such as {others[0]}"
        say(f"{folder}: reports leave out what this grid has no cell of: {named}")
