"""Runs cells on the workers of a Dask cluster, each of which sees the sweep's folder under the same path."""

from __future__ import annotations

import logging
import re
import socket
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any
from uuid import uuid4

from distributed import Client, Future, KilledWorker, Security, Status, Worker, get_worker

from coop.common.errors import RunError, UsageError
from coop.common.places import working_directory
from coop.common.process.cli import PACKAGE
from coop.studies.sweep.folder import CellFolder, Ending
from coop.studies.sweep.grid import GridFile
from coop.studies.sweep.local import LocalProcesses
from coop.studies.sweep.runner import Runner

CONNECT = 10.0  # seconds to reach the scheduler, also after its connection was lost
LOOK = 2.0  # seconds between looks at the workers
TICK = 0.2  # seconds
SAME = ("dask", "distributed", PACKAGE)  # packages that must have the same version everywhere
AT_WORK = (Status.running, Status.paused)


@contextmanager
def workers_at(address: str, grid: GridFile, jobs: int | None) -> Iterator[DaskWorkers]:
    """Connect to the scheduler at `address`; jobs: see `DaskWorkers`.

    Raises:
        UsageError: the address is not valid.
        RunError: the scheduler does not answer, or other versions run there.
    """
    if not re.fullmatch(r"(tcp|tls)://[^/]+:\d{1,5}", address):
        raise UsageError(f"--dask {address}: not an address; allowed: tcp://HOST:PORT and tls://HOST:PORT")
    if address.startswith("tls") and Security().get_connection_args("client")["ssl_context"] is None:
        raise UsageError(f"--dask {address}: Dask's settings name no certificates (distributed.comm.tls)")
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # the sweep says itself what matters to it
    try:
        with warnings.catch_warnings(action="ignore"):  # of versions, which are checked below
            client = Client(address, timeout=CONNECT, set_as_default=False)
    except OSError as error:
        raise RunError(f"--dask {address}: no Dask scheduler answers there within {CONNECT:g} s") from error
    with client:
        yield DaskWorkers(address, client, grid, jobs)


class DaskWorkers:
    """An executor: a task of the cluster is a sweep of one cell, on the worker that the scheduler chooses.

    The scheduler gives the cell of a worker that has died to another one. There it waits for the cell's lock, which the
    run holds until it has saved its state, if it outlives its worker.

    Args:
        jobs: number of cells to hand to the scheduler at a time; the workers' number of threads, as workers come and
            go, if None.
    """

    def __init__(self, address: str, client: Client, grid: GridFile, jobs: int | None) -> None:
        self._address = address
        self._client = client
        self._grid = grid
        self._jobs = jobs
        self._futures: dict[str, Future] = {}
        self._workers: dict[str, int] | None = None  # threads by address
        self._look_at = 0.0

    def slots(self) -> int:
        """See `Executor`."""
        if not self._connected():
            return 0
        return self._jobs or sum((self._workers or {}).values())

    def start(self, folder: CellFolder) -> bool:
        """See `Executor`; the worker waits where another process holds the cell."""
        name = folder.cell.name
        there = CellFolder(folder.path.parent.resolve(), folder.cell, folder.log)
        self._futures[name] = self._client.submit(
            run_cell, there, self._grid, working_directory(), key=f"{name}-{uuid4().hex}", pure=False
        )
        return True

    def ending(self, folder: CellFolder) -> Ending | None:
        """See `Executor`."""
        if not self._connected():
            return None
        ending = _ending(self._futures[folder.cell.name])
        if ending is not None:
            del self._futures[folder.cell.name]
        return ending

    def stop(self, seconds: float) -> None:
        """See `Executor`: cancelled tasks that wait for a worker never start, `run_cell` ends the others."""
        keys = {future.key for future in self._futures.values()}
        deadline = time.monotonic() + seconds
        with suppress(OSError):  # without the scheduler, the workers close
            if self._connected():
                self._client.cancel(list(self._futures.values()))
            while self._connected() and keys & self._held_keys() and time.monotonic() < deadline:
                time.sleep(TICK)
        self._futures.clear()

    def news(self) -> list[str]:
        """See `Executor`: the dashboard's address, and workers that come and go.

        Raises:
            RunError: the scheduler has gone, or another version runs there or on a worker.
        """
        if self._client.status == "closed":
            raise RunError(f"--dask {self._address}: the scheduler has gone; the same command goes on from here")
        if not self._connected() or time.monotonic() < self._look_at:
            return []
        self._look_at = time.monotonic() + LOOK
        try:
            found = self._client.sync(self._client.scheduler.ncores, callback_timeout=CONNECT)
            if found == self._workers:
                return []
            problem = difference(self._client.get_versions(packages=[PACKAGE]))
        except OSError:  # the client connects again, or gives up
            return []
        before, self._workers = self._workers, found
        if problem is not None:
            raise RunError(f"--dask {self._address}: {problem}")
        text = f"workers: {len(found)}, threads: {sum(found.values())}"
        if before is None:
            return [*self._dashboard(), text]
        gone = sorted(before.keys() - found.keys())
        return [f"{text}; gone: {', '.join(gone)}" if gone else text]

    def _connected(self) -> bool:
        """False while the client tries to reach the scheduler again, and once it has given up."""
        return bool(self._client.status == "running")

    def _held_keys(self) -> set[str]:
        """The keys of the tasks that workers run or hold."""
        return set(chain(*self._client.run(keys_of, on_error="ignore").values()))

    def _dashboard(self) -> list[str]:
        try:
            return [f"dashboard: {self._client.dashboard_link}"]
        except KeyError:  # this scheduler has none
            return []


def run_cell(folder: CellFolder, grid: GridFile, directory: Path) -> Ending:
    """Run one cell in a process of its own; a task of a worker.

    The run stops cleanly where the worker closes, or the scheduler cancels the task, as it does for a client that is
    gone.

    Args:
        folder: absolute.
        directory: working directory of the cell's process, if this host has it.
    """
    worker = get_worker()
    key = worker.get_current_task()
    runner = Runner([folder], LocalProcesses(grid, 1, directory if directory.is_dir() else None))
    try:
        while not runner.done and worker.status in AT_WORK and worker.state.tasks[key].state == "executing":
            runner.tick()
            time.sleep(TICK)
    finally:
        runner.abort()
    ending = runner.endings.get(folder.cell.name, Ending("lost", "its worker was closed"))
    return replace(ending, why=f"{ending.why}, on {socket.gethostname()}") if ending.kind == "failed" else ending


def difference(found: dict[str, Any]) -> str | None:
    """The first version that is not this process's; found: what `Client.get_versions` returns."""
    ours = _versions(found["client"])
    for name, theirs in {"the scheduler": found["scheduler"], **found["workers"]}.items():
        for package, version in _versions(theirs).items():
            if version != ours[package]:
                return f"{package} is {version or 'missing'} at {name}, {ours[package]} here"
    return None


def keys_of(dask_worker: Worker) -> list[str]:
    """The keys of the tasks that a worker runs or holds; a cancelled one is held until its function returns."""
    return list(dask_worker.state.tasks)


def _ending(future: Future) -> Ending | None:
    """How a task ended, None while it runs."""
    match future.status:
        case "pending":
            return None
        case "finished":
            try:
                ending: Ending = future.result(timeout=LOOK)
                return ending
            except (OSError, CancelledError):  # its worker died with the result: the scheduler runs it again
                return None
        case "error":
            error = future.exception(timeout=LOOK)
            if isinstance(error, KilledWorker):
                return Ending("failed", f"{error.allowed_failures + 1} workers died while they had it")
            return Ending("failed", f"{type(error).__name__}: {' '.join(str(error).split())}")
    return Ending("lost", "the scheduler has lost it")


def _versions(found: dict[str, Any]) -> dict[str, str | None]:
    """The versions of what must be the same everywhere; of Python major and minor."""
    packages = found["packages"]
    python = ".".join(packages["python"].split(".")[:2])
    return {"python": python, **{name: packages[name] for name in SAME}}
