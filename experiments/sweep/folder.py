"""A cell's folder: the state of its run, the config that it must hold, and the lock of the process that runs it."""

from __future__ import annotations

import csv
import io
import os
import secrets
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from common.errors import UsageError
from common.process.locks import Held, RunLock
from common.process.summaries import read_summary
from common.process.untrusted import check_links
from common.returns import RETURN_WINDOW
from common.settings.tables import identity, resolve, to_toml
from experiments.sweep.grid import Cell, Grid

TAIL = 16_384  # bytes of episodes.csv, enough for 100 lines


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

    def __init__(self, sweep: Path, cell: Cell) -> None:
        self.cell = cell
        self.path = sweep / cell.name

    def check(self) -> None:
        """Raise UsageError if the folder holds a run of another config."""
        check_links(self.path)
        held = self.path / "config.toml"
        text = held.read_text(encoding="utf-8") if held.exists() else ""
        try:
            # A kill during writing leaves an empty file.
            same = not text or identity(resolve(tomllib.loads(text))) == identity(self.cell.config)
        except (tomllib.TOMLDecodeError, UsageError):
            same = False
        if not same:
            raise UsageError(f"{held}: not the config of this grid's cell; give another --dir")

    def ending(self) -> Ending | None:
        """How its run ended for good; None if it has to be run or continued."""
        outcome = self.outcome()
        if outcome.startswith("complete"):
            return Ending("finished")
        return Ending("diverged", outcome) if outcome.startswith("diverged") else None

    def outcome(self) -> str:
        """How its run ended, from summary.json; empty if that does not exist."""
        return str(read_summary(self.path).get("exit", ""))

    def lock(self) -> RunLock | None:
        """The locks of the cell's run; None if another process has them. A child that inherits them keeps them."""
        try:
            return RunLock(self.path, "coop-sweep", ("learner", "replay"))
        except Held:
            return None

    def prepare(self) -> None:
        """Write the config from which the run starts or continues."""
        (self.path / "config.toml").write_text(to_toml(self.cell.config), encoding="utf-8")

    def progress(self) -> Progress:
        """Read the progress from the end of episodes.csv; zeros before the first episode's end."""
        try:
            with (self.path / "episodes.csv").open("rb") as file:
                header = file.readline().decode()
                file.seek(max(len(header), os.fstat(file.fileno()).st_size - TAIL))
                # The first and the last line of the tail may be incomplete.
                lines = file.read().decode().rpartition("\n")[0].splitlines()[-RETURN_WINDOW:]
        except FileNotFoundError:
            return Progress(0, 0.0)
        rows = list(csv.DictReader(io.StringIO("\n".join([header.strip(), *lines]))))
        if not rows:
            return Progress(0, 0.0)
        return Progress(int(rows[-1]["env_step"]), sum(float(row["return"]) for row in rows) / len(rows))


def default_folder(grid: str | Path, quick: bool) -> Path:
    """The folder of a sweep that names none."""
    return Path("runs") / "sweeps" / (Path(grid).stem + ("-quick" if quick else ""))


def claim_folder(grid: Grid, cells: Sequence[CellFolder], folder: Path) -> None:
    """Assign a folder to a sweep, or refuse it before anything runs.

    Raises:
        UsageError: it holds runs of other configs, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for cell in cells:
            cell.check()
        part = folder / f"sweep.toml.{secrets.token_hex(8)}"  # several sweeps may write it at once, from any host
        part.write_text(grid.to_toml(), encoding="utf-8")
        part.replace(folder / "sweep.toml")
    except OSError as error:
        raise UsageError(f"--dir {folder}: {error.strerror}") from error
