"""Runs cells as child processes on this machine."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import MappingProxyType

from coop.common.errors import RunError
from coop.common.process.limits import MIB, cores
from coop.common.process.processes import ChildProcess, command
from coop.records.locks import RunLock
from coop.studies.sweep.folder import CellFolder, Ending
from coop.studies.sweep.grid import GridFile
from coop.studies.sweep.stacking import Stacks

TOGETHER = "coop.lockstep.compiled.together"  # the module that plays several cells
# By default, the libraries that a run uses start a thread per core, and concurrent runs would starve each other.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
CELL_BYTES = 64 * MIB  # the least that a process of a cell takes


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
        jobs: number of processes to run concurrently; the number of cores of this job if None.
        stacks: the cells that a cell's process plays side by side (see `stacks_of`).
        directory: working directory of the cells, where they find users' own modules; this process's if None.
    """

    def __init__(
        self,
        grid: GridFile,
        jobs: int | None,
        directory: Path | None = None,
        stacks: Stacks = MappingProxyType({}),
    ) -> None:
        self._grid = grid
        self._jobs = jobs or cores()
        self._directory = directory
        self._stacks = stacks
        self._processes: dict[str, ChildProcess] = {}
        self._locks: dict[str, RunLock] = {}
        self._cards: dict[str, str] = {}

    def slots(self) -> int:
        """See `Executor`."""
        return self._jobs + len(self._processes) - len(self._running())

    def _running(self) -> set[ChildProcess]:
        return set(self._processes.values())

    def start(self, folder: CellFolder) -> bool:
        """See `Executor`. A cell that the process of another one has taken along counts as started."""
        name = folder.cell.name
        if name in self._processes:
            return True
        if len(self._running()) >= self._jobs:
            return False
        locks: dict[str, RunLock] = {}
        try:
            if not self._take(folder, locks):
                return False
            taken = [folder, *(cell for cell in self._mates(name) if self._taken_along(cell, locks))]
            log, inherited = folder.path / "run.log", tuple(d for lock in locks.values() for d in lock.descriptors)
            environment = self._environment(folder)
            process = ChildProcess(name, self._command(taken), log, inherited, environment, self._directory)
            process.start()
        except BaseException:
            for lock in locks.values():
                lock.release()
            raise
        self._processes |= dict.fromkeys(locks, process)
        self._locks |= locks
        return True

    def _mates(self, name: str) -> list[CellFolder]:
        """The other cells that the process of a cell may play."""
        return [cell for cell in self._stacks.get(name, ()) if cell.cell.name not in (name, *self._processes)]

    def _taken_along(self, folder: CellFolder, locks: dict[str, RunLock]) -> bool:
        """As `_take`, but leave a cell that fails: it says why once it is started itself."""
        try:
            return self._take(folder, locks)
        except (OSError, RunError):
            if (lock := locks.pop(folder.cell.name, None)) is not None:
                lock.release()
            return False

    def _take(self, folder: CellFolder, locks: dict[str, RunLock]) -> bool:
        """Lock and prepare a cell; False if another process holds it or has ended it."""
        lock = None if folder.ending() is not None else folder.lock()
        if lock is None:
            return False
        locks[folder.cell.name] = lock
        if folder.ending() is not None:
            locks.pop(folder.cell.name).release()
            return False
        folder.prepare()
        return True

    def ending(self, folder: CellFolder) -> Ending | None:
        """See `Executor`."""
        name = folder.cell.name
        process = self._processes[name]
        status = process.exit_status()
        if status is None:
            return None
        self._ended(name)
        ending = folder.ending()
        alone = name not in self._stacks  # otherwise the status may be that of another cell
        if ending is None or (ending.kind == "finished" and status and alone):
            why = process.why() if status else f"stopped early: {folder.outcome() or 'no summary.json'}"
            return Ending("failed", why)
        return ending

    def interrupt(self, folder: CellFolder) -> None:
        """Ask the process of a running cell to save its state and end."""
        if (process := self._processes.get(folder.cell.name)) is not None:
            process.interrupt()

    def stop(self, seconds: float) -> None:
        """See `Executor`."""
        running = self._running()
        for process in running:
            process.interrupt()
        deadline = time.monotonic() + seconds
        for process in running:
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

    def _command(self, cells: Sequence[CellFolder]) -> list[str]:
        if len(cells) > 1:
            return [sys.executable, "-P", "-m", TOGETHER, f"--log={cells[0].log}", *(str(cell.path) for cell in cells)]
        (folder,) = cells
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
