"""Runs cells as child processes on this machine."""

from __future__ import annotations

import time
from pathlib import Path

from common.process.limits import cores
from common.process.processes import ChildProcess, command
from experiments.sweep.folder import CellFolder, Ending
from experiments.sweep.grid import GridFile

# By default, the libraries that a run uses start a thread per core, and concurrent runs would starve each other.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class LocalProcesses:
    """An executor. A cell's process holds its lock as long as it lives, even if the sweep has been killed.

    Args:
        jobs: number of cells to run concurrently; the number of cores of this job if None.
        directory: working directory of the cells, where they find users' own modules; this process's if None.
    """

    def __init__(self, grid: GridFile, jobs: int | None, directory: Path | None = None) -> None:
        self._grid = grid
        self._jobs = jobs or cores()
        self._directory = directory
        self._processes: dict[str, ChildProcess] = {}

    def slots(self) -> int:
        """See `Executor`."""
        return self._jobs

    def start(self, folder: CellFolder) -> bool:
        """See `Executor`."""
        name = folder.cell.name
        with folder.locked() as lock:
            if lock is None or folder.ending() is not None:
                return False
            folder.prepare()
            log, locks = folder.path / "run.log", (lock,)
            process = ChildProcess(name, self._command(folder), log, locks, ONE_THREAD, self._directory)
            process.start()
        self._processes[name] = process
        return True

    def ending(self, folder: CellFolder) -> Ending | None:
        """See `Executor`."""
        process = self._processes[folder.cell.name]
        status = process.exit_status()
        if status is None:
            return None
        del self._processes[folder.cell.name]
        ending = folder.ending()
        if ending is None or (ending.kind == "finished" and status):
            why = process.why() if status else f"stopped early: {folder.outcome() or 'no summary.json'}"
            return Ending("failed", why)
        return ending

    def stop(self, seconds: float) -> None:
        """See `Executor`."""
        for process in self._processes.values():
            process.interrupt()
        deadline = time.monotonic() + seconds
        for process in self._processes.values():
            process.end(max(0.0, deadline - time.monotonic()))
        self._processes.clear()

    def news(self) -> list[str]:
        """See `Executor`; nothing happens to this machine."""
        return []

    def _command(self, folder: CellFolder) -> list[str]:
        # --resume also at the first start, so that a restarted run continues from its newest checkpoint.
        flags = [f"--config={folder.path / 'config.toml'}", f"--run-dir={folder.path}", "--resume"]
        if self._grid.mode == "distributed":
            return command("coop-local", *flags, f"--actors={self._grid.actors}")
        return command("coop-lockstep", *flags)
