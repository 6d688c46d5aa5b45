"""Follows a sweep, or any folder of runs, by the files in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from coop.common.errors import RunError, UsageError
from coop.common.process.processes import SAYS_WHY, reason_in
from coop.common.process.untrusted import read_text
from coop.common.settings.overrides import leaves
from coop.common.settings.tables import CONFIG, check_toml
from coop.records.checkpoints import RECORDS, SWEEP
from coop.records.growing import tail
from coop.records.locks import holder
from coop.records.reading import parse_row, read_run_config, run_names
from coop.records.summaries import SUMMARY, read_summary
from coop.studies.sweep.grid import Choice, Grid, parse_grid
from coop.studies.watch.run import EpisodeFacts

State = Literal["waiting", "running", "stopped", "finished", "diverged", "failed"]
OVER: tuple[State, ...] = ("finished", "diverged", "failed")
CURVE = 60  # points of a cell's curve


@dataclass(frozen=True)
class Shown:
    """A cell at one moment.

    group: what it is, but for its seed. step, total: environment steps; total is None while it is not known.
    speed: steps/s of a running one. why: how a diverged or failed one ended, or the last words of a stopped one.
    """

    name: str
    group: str
    seed: str
    state: State
    step: int
    total: int | None
    mean_return: float
    speed: float
    why: str


class CellFiles:
    """One cell of a sweep as its files tell it."""

    def __init__(self, path: Path, group: str, seed: str, total: int | None) -> None:
        self.path, self.group, self.seed = path, group, seed
        self.total = total
        self.episodes = EpisodeFacts(path, CURVE)
        self._configured = False
        self._ended_at = 0.0
        self.now = Shown(path.name, group, seed, "waiting", 0, total, 0.0, 0.0, "")

    def refresh(self) -> None:
        """Read what is new."""
        if not self.path.is_dir():
            return
        ended_at = _changed(self.path / SUMMARY)
        if self.now.state in ("finished", "diverged") and ended_at == self._ended_at:
            return
        self._ended_at = ended_at
        self._read_config()
        self.episodes.refresh()
        state, why = self._state()
        row = _newest_row(self.path) if state == "running" else {}
        step = max(int(float(self.episodes.newest.get("env_step", 0))), int(row.get("env_step", 0)))
        if state == "finished":
            step = self.total or step
        speed = float(row.get("env_steps_per_s") or 0)
        self.now = Shown(self.path.name, self.group, self.seed, state, step, self.total, self.episodes.mean, speed, why)

    def _read_config(self) -> None:
        if not self._configured and (self.path / CONFIG).exists():
            try:
                config = read_run_config(self.path)
            except UsageError:
                return  # half written, or another's: the cell's own command says so
            self.total, self._configured = config.total_steps, True
            self.group = self.group or f"{config.env.id}, {config.method}"
            self.seed = self.seed or str(config.seed)

    def _state(self) -> tuple[State, str]:
        if holder(self.path)[1]:
            return "running", ""
        try:
            outcome = str(read_summary(self.path).get("exit", ""))
        except RunError as error:
            return "failed", str(error)
        if outcome.startswith("complete"):
            return "finished", ""
        if outcome.startswith("diverged"):
            return "diverged", outcome
        lines = [line for line in tail(self.path / "run.log").splitlines() if line.strip()]
        if outcome.startswith("failed") or (lines and SAYS_WHY in lines[-1]):
            return "failed", reason_in(lines) if lines else outcome
        return "stopped" if self.episodes.count or outcome or lines else "waiting", outcome


class SweepFolder:
    """The cells of a sweep; of a folder of runs without a grid, the runs.

    name: of the folder. title: of the grid.

    Raises:
        UsageError: the folder holds neither, or sweep.toml can't be read.
    """

    def __init__(self, path: Path) -> None:
        self.name, self.title, self._path = path.resolve().name, "", path
        self.files: dict[str, CellFiles] = {}
        self._whole = (path / SWEEP).exists()
        if self._whole:
            text = read_text(path / SWEEP)
            check_toml(text, path / SWEEP, needed=False)
            grid = parse_grid(text, str(path / SWEEP), check=False)  # a check would import what the grid names
            self.title = grid.file.title
            for choice in grid.choices:
                self.files[choice.name] = CellFiles(path / choice.name, *_described(grid, choice))
        elif not run_names(path):
            raise UsageError(f"{path}: neither a run, with its {CONFIG}, nor a sweep, with its {SWEEP}")

    def refresh(self) -> None:
        """Read what is new."""
        for name in () if self._whole else run_names(self._path):
            self.files.setdefault(name, CellFiles(self._path / name, "", "", None))
        for cell in self.files.values():
            cell.refresh()

    @property
    def cells(self) -> list[Shown]:
        """All cells, in the order in which they are run."""
        return [cell.now for cell in self.files.values()]

    @property
    def over(self) -> bool:
        """True if no cell runs and none is left, or a sweep's cells have all ended."""
        return all(cell.state in OVER or (not self._whole and cell.state == "stopped") for cell in self.cells)

    def counts(self) -> dict[State, int]:
        """The number of cells by state, without states that none is in."""
        found = Counter(cell.state for cell in self.cells)
        order: tuple[State, ...] = ("finished", "running", "waiting", "stopped", "diverged", "failed")
        return {state: found[state] for state in order if found[state]}

    def steps(self) -> tuple[int, int]:
        """Environment steps done, and of the whole sweep; a cell whose number is not known counts as the others."""
        known = [cell.total for cell in self.cells if cell.total]
        usual = round(sum(known) / len(known)) if known else 0
        totals = [(cell, cell.total or usual) for cell in self.cells]
        done = sum(total if cell.state in OVER else min(cell.step, total) for cell, total in totals)
        return done, sum(total for _, total in totals)

    def speed(self) -> float:
        """Environment steps per second of all running cells."""
        return sum(cell.speed for cell in self.cells)

    def seconds_left(self) -> float | None:
        """The time left at that speed; None where nothing runs."""
        done, total = self.steps()
        speed = self.speed()
        return (total - done) / speed if speed else None

    def failures(self) -> Iterable[Shown]:
        """The cells that have failed or diverged, or were stopped with last words."""
        return (cell for cell in self.cells if cell.state in ("failed", "diverged"))

    def report(self) -> dict[str, Any]:
        """All of it as plain values."""
        done, total = self.steps()
        cells = [{name: getattr(cell, name) for name in Shown.__dataclass_fields__} for cell in self.cells]
        left = {"env_steps_per_s": self.speed(), "seconds_left": self.seconds_left()}
        head = {"sweep": self.name, "title": self.title, "counts": self.counts()}
        return {**head, "env_steps": done, "total_steps": total, **left, "cells": cells}


def _described(grid: Grid, choice: Choice) -> tuple[str, str, int | None]:
    """Of a cell: what it is but for its seed, the seed, and its number of steps if the grid says it."""
    values = [f"{path[-1]} {value}" for path, value in choice.values.items()]
    fixed = dict(leaves(grid.file.fixed)) | dict(choice.values)
    total = fixed.get(("total_steps",))
    return ", ".join([choice.method, *values]), str(choice.seed), total if type(total) is int else None


def _newest_row(folder: Path) -> dict[str, Any]:
    """The last whole row of metrics.jsonl; empty if there is none."""
    lines = tail(folder / RECORDS[1]).rpartition("\n")[0].splitlines()
    try:
        return parse_row(lines[-1], "") if lines else {}
    except RunError:
        return {}


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
