"""Runs a grid's cells as child processes, a given number concurrently; never repeats finished cells."""

from __future__ import annotations

import os
import time
from collections import deque
from dataclasses import dataclass, field

from common.process.processes import ChildProcess, command
from experiments.sweep.folder import CellFolder, Progress
from experiments.sweep.grid import GridFile

GRACE = 60.0  # seconds for a run to save its state
# By default, the libraries that a run uses start a thread per core, and concurrent runs would starve each other.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
RETRY = 1.0  # seconds before retrying a cell that another process holds


@dataclass
class Running:
    """A cell's child process; began: the environment step from which it continued."""

    folder: CellFolder
    process: ChildProcess
    began: int
    progress: Progress


@dataclass
class Tally:
    """The results of the cells, for displays.

    skipped: finished earlier. elsewhere: finished by another process meanwhile. failed: name and reason. diverged: name
    and how the run ended, now or earlier; such a cell is not repeated.
    steps: environment steps of the runs that this process has finished.
    """

    skipped: int = 0
    finished: int = 0
    elsewhere: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    diverged: dict[str, str] = field(default_factory=dict)
    steps: int = 0


class Runner:
    """Starts, watches and ends the cells' processes.

    A process holds its cell's lock as long as it lives, even if the sweep that started it has been killed. So two
    processes never run the same cell: a second sweep, and the tasks of a job array, share the work.
    """

    def __init__(self, grid: GridFile, folders: list[CellFolder], jobs: int | None) -> None:
        """jobs: number of cells to run concurrently; the number of cores if None."""
        self.folders = folders
        self.running: list[Running] = []
        self.tally = Tally()
        self.waiting: deque[CellFolder] = deque()
        self._grid = grid
        self._jobs = jobs or len(os.sched_getaffinity(0))
        self._retry_at: dict[str, float] = {}
        for folder in folders:
            if folder.finished():
                self.tally.skipped += 1
            elif folder.diverged():
                self.tally.diverged[folder.cell.name] = folder.outcome()
            else:
                self.waiting.append(folder)

    def tick(self) -> list[str]:
        """Collect ended processes and start new ones; return lines that describe what happened."""
        return [*self._collect(), *self._fill()]

    @property
    def done(self) -> bool:
        """True once no cell is left."""
        return not self.running and not self.waiting

    def steps_left(self) -> int:
        """Remaining environment steps of the running and the waiting cells."""
        waiting = sum(folder.cell.config.total_steps for folder in self.waiting)
        return waiting + sum(run.folder.cell.config.total_steps - run.progress.step for run in self.running)

    def steps_done(self) -> int:
        """Environment steps done since this process started."""
        return self.tally.steps + sum(max(0, run.progress.step - run.began) for run in self.running)

    def abort(self, seconds: float = GRACE) -> None:
        """Ask every run to stop, and wait; kill runs that do not stop within `seconds`."""
        for run in self.running:
            run.process.interrupt()
        deadline = time.monotonic() + seconds
        for run in self.running:
            run.process.end(max(0.0, deadline - time.monotonic()))
            if run.folder.finished():
                self.tally.finished += 1
            elif run.folder.diverged():
                self.tally.diverged[run.folder.cell.name] = run.folder.outcome()
            else:
                self.waiting.append(run.folder)
        self.running.clear()

    def _collect(self) -> list[str]:
        happened = []
        for run in list(self.running):
            run.progress = run.folder.progress()
            status = run.process.exit_status()
            if status is None:
                continue
            self.running.remove(run)
            name = run.folder.cell.name
            if run.folder.finished() and status == 0:
                self.tally.finished += 1
                self.tally.steps += max(0, run.folder.cell.config.total_steps - run.began)
                happened.append(f"{name}: return {run.progress.mean_return:.1f}")
            elif run.folder.diverged():
                self.tally.diverged[name] = run.folder.outcome()
                happened.append(f"{name}: {run.folder.outcome()}")
            else:
                why = run.process.why() if status else f"stopped early: {run.folder.outcome() or 'no summary.json'}"
                self.tally.failed[name] = why
                happened.append(f"{name}: FAILED, {why}")
        return happened

    def _fill(self) -> list[str]:
        happened = []
        for _ in range(len(self.waiting)):
            if len(self.running) >= self._jobs:
                break
            folder = self.waiting.popleft()
            if (problem := self._start(folder)) is not None:
                self.tally.failed[folder.cell.name] = problem
                happened.append(f"{folder.cell.name}: FAILED, {problem}")
        return happened

    def _start(self, folder: CellFolder) -> str | None:
        """Start a cell, or put it back if another process holds it; return the reason if it cannot be started."""
        name, now = folder.cell.name, time.monotonic()
        if now < self._retry_at.get(name, 0.0):
            self.waiting.append(folder)
            return None
        try:
            with folder.locked() as lock:
                if lock is None:
                    self._retry_at[name] = now + RETRY
                    self.waiting.append(folder)
                elif folder.finished():
                    self.tally.elsewhere += 1
                elif folder.diverged():
                    self.tally.diverged[name] = folder.outcome()
                else:
                    began = folder.progress().step
                    folder.prepare()
                    process = ChildProcess(name, self._command(folder), folder.path / "run.log", (lock,), ONE_THREAD)
                    process.start()
                    self.running.append(Running(folder, process, began, Progress(began, 0.0)))
        except OSError as error:
            return f"{error.filename or folder.path}: {error.strerror}"
        return None

    def _command(self, folder: CellFolder) -> list[str]:
        # --resume also at the first start, so that a restarted run continues from its newest checkpoint.
        flags = [f"--config={folder.path / 'config.toml'}", f"--run-dir={folder.path}", "--resume"]
        if self._grid.mode == "distributed":
            return command("coop-local", *flags, f"--actors={self._grid.actors}")
        return command("coop-lockstep", *flags)
