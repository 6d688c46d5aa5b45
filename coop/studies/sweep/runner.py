"""Hands a grid's cells to an executor, as many as it takes at a time; never repeats finished cells."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Protocol

from coop.common.errors import RunError
from coop.studies.sweep.folder import CellFolder, Ending, Progress


class Executor(Protocol):
    """Runs cells, each in a process of its own that holds the cell's lock."""

    def slots(self) -> int:
        """The number of cells that it takes now."""

    def start(self, folder: CellFolder) -> bool:
        """Start a cell; False if another process holds it or has ended it. Raises OSError if it cannot be started."""

    def ending(self, folder: CellFolder) -> Ending | None:
        """How a cell that it has started ended; None while it runs. Not asked again after an ending."""

    def stop(self, seconds: float) -> None:
        """Ask all cells to stop cleanly, and wait; end those that do not stop within `seconds`."""

    def news(self) -> list[str]:
        """Lines that describe what has happened to the place itself. Raises RunError if it is gone."""


GRACE = 60.0  # seconds for a run to save its state
RETRY = 1.0  # seconds before retrying a cell that another process holds, or whose worker is gone


@dataclass
class Running:
    """A cell that an executor runs; began: the environment step from which it continued."""

    folder: CellFolder
    began: int
    progress: Progress


class Runner:
    """Starts, watches and ends the runs of a sweep's cells.

    Two processes never run the same cell, as each holds the cell's lock: a second sweep, the tasks of a job array and
    the workers of a cluster share the work.

    Attributes:
        endings: of the cells that have ended, by name, now or before this sweep.
        skipped: number of cells that were finished before.
    """

    def __init__(self, folders: list[CellFolder], executor: Executor) -> None:
        self.folders = folders
        self.running: list[Running] = []
        self.waiting: deque[CellFolder] = deque()
        self.endings: dict[str, Ending] = {}
        self._executor = executor
        self._retry_at: dict[str, float] = {}
        self._steps = 0  # of the runs that have ended
        for folder in folders:
            ending = folder.ending()
            if ending is None:
                self.waiting.append(folder)
            else:
                self.endings[folder.cell.name] = ending
        self.skipped = self.finished

    def tick(self) -> list[str]:
        """Collect ended runs and start new ones; return lines that describe what happened."""
        return [*self._executor.news(), *self._collect(), *self._fill()]

    @property
    def done(self) -> bool:
        """True once no cell is left."""
        return not self.running and not self.waiting

    @property
    def finished(self) -> int:
        """Number of finished cells."""
        return sum(ending.kind == "finished" for ending in self.endings.values())

    @property
    def diverged(self) -> dict[str, str]:
        """How each diverged run ended, by the cell's name; such a cell is not repeated."""
        return {name: ending.why for name, ending in self.endings.items() if ending.kind == "diverged"}

    @property
    def failed(self) -> dict[str, str]:
        """Why each failed cell could not be run, by its name."""
        return {name: ending.why for name, ending in self.endings.items() if ending.kind == "failed"}

    def look(self) -> None:
        """Read the progress of the running cells."""
        for run in self.running:
            run.progress = run.folder.progress()

    def steps_left(self) -> int:
        """Remaining environment steps of the running and the waiting cells."""
        waiting = sum(folder.cell.config.total_steps for folder in self.waiting)
        return waiting + sum(run.folder.cell.config.total_steps - run.progress.step for run in self.running)

    def steps_done(self) -> int:
        """Environment steps done since this process started."""
        return self._steps + sum(max(0, run.progress.step - run.began) for run in self.running)

    def abort(self, seconds: float = GRACE) -> None:
        """Ask every run to stop, and wait; end runs that do not stop within `seconds`."""
        self._executor.stop(seconds)
        for run in self.running:
            ending = run.folder.ending()
            if ending is None:
                self.waiting.append(run.folder)
            else:
                self.endings[run.folder.cell.name] = ending
        self.running.clear()

    def _collect(self) -> list[str]:
        happened = []
        for run in list(self.running):
            ending = self._executor.ending(run.folder)
            if ending is not None:
                self.running.remove(run)
                happened.append(self._conclude(run, ending))
        return happened

    def _conclude(self, run: Running, ending: Ending) -> str:
        """Record how a run ended; return the line that says so."""
        name = run.folder.cell.name
        if ending.kind == "lost":
            self._wait(run.folder)
            return f"{name}: {ending.why}; it runs again"
        self.endings[name] = ending
        if ending.kind == "finished":
            self._steps += max(0, run.folder.cell.config.total_steps - run.began)
            return f"{name}: return {run.folder.progress().mean_return:.1f}"
        return f"{name}: FAILED, {ending.why}" if ending.kind == "failed" else f"{name}: {ending.why}"

    def _fill(self) -> list[str]:
        happened, slots = [], self._executor.slots()
        for _ in range(len(self.waiting)):
            if len(self.running) >= slots:
                break
            folder = self.waiting.popleft()
            if (problem := self._start(folder)) is not None:
                self.endings[folder.cell.name] = Ending("failed", problem)
                happened.append(f"{folder.cell.name}: FAILED, {problem}")
        return happened

    def _start(self, folder: CellFolder) -> str | None:
        """Start a cell, or put it back if another process holds it; return the reason if it cannot be started."""
        name = folder.cell.name
        if time.monotonic() < self._retry_at.get(name, 0.0):
            self.waiting.append(folder)
        elif (ending := folder.ending()) is not None:
            self.endings[name] = ending
        else:
            progress = folder.progress()
            try:
                started = self._executor.start(folder)
            except OSError as error:
                return f"{error.filename or folder.path}: {error.strerror}"
            except RunError as error:
                return str(error)
            if started:
                self.running.append(Running(folder, progress.step, progress))
            else:
                self._wait(folder)
        return None

    def _wait(self, folder: CellFolder) -> None:
        self._retry_at[folder.cell.name] = time.monotonic() + RETRY
        self.waiting.append(folder)
