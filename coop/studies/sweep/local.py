"""Runs cells as child processes on this machine."""

from __future__ import annotations

import os
import time
from collections import Counter
from pathlib import Path

from coop.common.process.limits import cores
from coop.common.process.processes import ChildProcess, command
from coop.records.locks import RunLock
from coop.studies.sweep.folder import CellFolder, Ending
from coop.studies.sweep.grid import GridFile

# By default, the libraries that a run uses start a thread per core, and concurrent runs would starve each other.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def cards() -> list[str]:
    """The GPUs of this job, as CUDA_VISIBLE_DEVICES names them: those of the variable, or else of this machine."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return [name for name in named.split(",") if name]
    return sorted((path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*")), key=int)


class LocalProcesses:
    """An executor. A cell's process shares the run's locks with the sweep, and keeps them if the sweep is killed.

    Of several GPUs each cell with `learner.device = "cuda"` sees one, that with the fewest cells.

    Args:
        jobs: number of cells to run concurrently; the number of cores of this job if None.
        directory: working directory of the cells, where they find users' own modules; this process's if None.
    """

    def __init__(self, grid: GridFile, jobs: int | None, directory: Path | None = None) -> None:
        self._grid = grid
        self._jobs = jobs or cores()
        self._directory = directory
        self._processes: dict[str, ChildProcess] = {}
        self._locks: dict[str, RunLock] = {}
        self._cards: dict[str, str] = {}

    def slots(self) -> int:
        """See `Executor`."""
        return self._jobs

    def start(self, folder: CellFolder) -> bool:
        """See `Executor`."""
        name = folder.cell.name
        lock = folder.lock()
        if lock is None:
            return False
        try:
            if folder.ending() is not None:
                lock.release()
                return False
            folder.prepare()
            log, command = folder.path / "run.log", self._command(folder)
            process = ChildProcess(name, command, log, lock.descriptors, self._environment(folder), self._directory)
            process.start()
        except BaseException:
            lock.release()
            raise
        self._processes[name], self._locks[name] = process, lock
        return True

    def ending(self, folder: CellFolder) -> Ending | None:
        """See `Executor`."""
        process = self._processes[folder.cell.name]
        status = process.exit_status()
        if status is None:
            return None
        self._ended(folder.cell.name)
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
        for name in list(self._processes):
            self._ended(name)

    def news(self) -> list[str]:
        """See `Executor`; nothing happens to this machine."""
        return []

    def _environment(self, folder: CellFolder) -> dict[str, str]:
        """What a cell's process gets besides this one's environment."""
        if folder.cell.config.learner.device != "cuda" or not (found := cards()):
            return ONE_THREAD
        load = Counter(card for name, card in self._cards.items() if name in self._processes)
        self._cards[folder.cell.name] = card = min(found, key=load.__getitem__)
        return {**ONE_THREAD, "CUDA_VISIBLE_DEVICES": card}

    def _ended(self, name: str) -> None:
        """Release a cell's locks; those of a run that was killed are its own children's, if some outlive it."""
        lock, status = self._locks.pop(name), self._processes.pop(name).exit_status()
        lock.release() if status is not None and status >= 0 else lock.hand_over()

    def _command(self, folder: CellFolder) -> list[str]:
        # --resume also at the first start, so that a restarted run continues from its newest checkpoint.
        flags = [
            f"--config={folder.path / 'config.toml'}",
            f"--run-dir={folder.path}",
            "--resume",
            f"--log={folder.log}",
        ]
        modules = [path.partition(":")[0] for path in folder.cell.config.imports.values()]
        flags += ["--allow-import", *modules] if modules else []
        if self._grid.mode == "distributed":
            return command("coop-local", *flags, f"--actors={self._grid.actors}")
        return command("coop-lockstep", *flags)
