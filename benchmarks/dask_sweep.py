"""Runs a sweep on a Dask cluster and kills workers: `make dask-test`, which needs root.

The hosts are network namespaces: one with the scheduler and `coop-sweep`, three with a worker each. First one worker's
process is killed, which its cell's run outlives, and half-way all processes of another host. Every cell must be
completed once, by one process at a time, and the cells that were hit must have the episodes of an undisturbed run, to
the byte. Otherwise the exit status is 1.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hosts import Host, network_of
from roles import wait_until

from coop.common.errors import CoopError, RunError
from coop.common.process.processes import ChildProcess, command
from coop.records.summaries import read_summary

TOTAL_STEPS = 2000
GRID = f"""
title = "A worker is killed half-way"
methods = ["dqn", "coop"]
seeds = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]
[fixed]
total_steps = {TOTAL_STEPS}
checkpoint_every = 200
"""
CELLS = 24
WORKERS = ("one", "two", "three")
PORT = 8786
PATIENCE = 900.0  # seconds for a part of the sweep
DASK = str(Path(sys.executable).with_name("dask"))


class Sweep:
    """A sweep on the hosts, in a folder with its grid, its runs and everybody's logs."""

    def __init__(self, folder: Path, hosts: dict[str, Host]) -> None:
        self.runs = folder / "runs"
        self.most = 0  # processes of one cell at a time, as far as seen
        self._folder, self._hosts = folder, hosts
        (folder / "grid.toml").write_text(GRID, encoding="utf-8")
        self._at = f"tcp://{hosts['head'].address(4)}:{PORT}"

    @contextmanager
    def begun(self) -> Iterator[ChildProcess]:
        """Start the cluster and the sweep, whose process it yields."""
        hosts, place = self._hosts, self._folder
        self._start("head", "scheduler", [DASK, "scheduler", f"--host={hosts['head'].address(4)}", f"--port={PORT}"])
        for name in WORKERS:
            own = (f"--host={hosts[name].address(4)}", f"--name={name}", f"--local-directory={place / name}")
            self._start(name, f"worker-{name}", [DASK, "worker", self._at, "--nthreads=1", "--no-dashboard", *own])
        try:
            yield self._start("head", "sweep", self.command(self.runs, f"--dask={self._at}"))
        finally:
            for name in hosts:
                self._kill_all(name)

    def command(self, runs: Path, *flags: str) -> list[str]:
        """The command line of a sweep into `runs`."""
        return command("coop-sweep", str(self._folder / "grid.toml"), f"--dir={runs}", *flags)

    def finished(self) -> int:
        """Number of complete cells."""
        cells = Counter(cell for host in WORKERS for cell in self._cells(host).values())
        self.most = max(self.most, *cells.values(), 0)
        return sum(read_summary(run.parent)["exit"] == "complete" for run in self.runs.glob("*/summary.json"))

    def kill_worker(self, host: str) -> str:
        """Kill the process of the worker while it runs a cell, early in it; return the cell."""
        pid, cell = self._running(host)
        os.kill(
            int(Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[1]), signal.SIGKILL
        )
        return cell

    def kill_host(self, host: str) -> str:
        """Kill all processes of the host while it runs a cell, early in it; return the cell."""
        _, cell = self._running(host)
        self._kill_all(host)
        return cell

    def check(self, hit: list[str]) -> None:
        """Raise RunError where a cell is not complete, was repeated, or of those hit, has other episodes than alone."""
        if self.most != 1:
            raise RunError(f"{self.most} processes of one cell at a time")
        for run in sorted(self.runs.glob("*/run.log")):
            log, cell = run.read_text(encoding="utf-8"), run.parent.name
            if (count := sum(line.startswith("complete:") for line in log.splitlines())) != 1:
                raise RunError(f"{cell} was completed {count} times")
            if cell in hit:
                if "resuming from checkpoint" not in log:
                    raise RunError(f"{cell} began anew")
                alone = self._folder / "alone"
                subprocess.run(self.command(alone, f"--cell={cell}"), stdout=subprocess.DEVNULL, check=True)
                files = [folder / cell / "episodes.csv" for folder in (self.runs, alone)]
                if files[0].read_bytes() != files[1].read_bytes():
                    raise RunError(f"{cell} has other episodes than an undisturbed run")

    def _running(self, host: str) -> tuple[int, str]:
        """A cell that runs on the host, once one has a saved checkpoint of its first half: its process and its name."""
        found: list[tuple[int, str]] = []

        def early(cell: str) -> bool:
            checkpoints = [int(done.parent.name) for done in self.runs.glob(f"{cell}/checkpoints/*/DONE")]
            return 0 < max(checkpoints, default=0) <= TOTAL_STEPS // 2

        def saved() -> bool:
            found[:] = [(pid, cell) for pid, cell in self._cells(host).items() if early(cell)]
            return bool(found)

        wait_until(f"a cell with a checkpoint on {host}", saved, PATIENCE)
        return found[0]

    def _cells(self, host: str) -> dict[int, str]:
        """The cells that run on a host, by their processes."""
        found = {}
        for pid in self._pids(host):
            try:
                words = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8").split("\0")
            except OSError:
                continue
            for word in words:
                if word.startswith("--run-dir="):
                    found[pid] = Path(word).name
        return found

    def _pids(self, host: str) -> list[int]:
        asked = ["ip", "netns", "pids", self._hosts[host].namespace]
        return [int(pid) for pid in subprocess.run(asked, capture_output=True, check=True).stdout.split()]

    def _kill_all(self, host: str) -> None:
        for pid in self._pids(host):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _start(self, host: str, name: str, words: list[str]) -> ChildProcess:
        process = ChildProcess(name, [*self._hosts[host].inside, *words], self._folder / f"{name}.log")
        process.start()
        return process


def run(folder: Path, hosts: dict[str, Host]) -> None:
    """Run the sweep, kill, and check; raises RunError if a check fails."""
    sweep = Sweep(folder, hosts)

    def until(count: int) -> None:
        def reached() -> bool:
            return sweep.finished() >= count or client.exit_status() is not None

        wait_until(f"{count} cells", reached, PATIENCE)

    with sweep.begun() as client:
        until(CELLS // 4)
        hit = [sweep.kill_worker("one")]
        print(f"worker one killed with {sweep.finished()} of {CELLS} cells finished; it ran {hit[0]}", flush=True)
        until(CELLS // 2)
        hit.append(sweep.kill_host("two"))
        print(f"host two killed with {sweep.finished()} of {CELLS} cells finished; it ran {hit[1]}", flush=True)
        until(CELLS)
        client.end(60)
        if client.exit_status():
            raise RunError(client.why())
        print((folder / "sweep.log").read_text(encoding="utf-8"), end="")
    sweep.check(hit)
    print(f"passed: {sweep.finished()} of {CELLS} cells complete, each completed once and run by one process at a time")


def main() -> None:
    """Make the hosts, and run the sweep on them."""
    if os.geteuid() or shutil.which("ip") is None:
        print("SKIP: making network namespaces needs root and iproute2")
        return
    try:
        with network_of(os.getpid(), ["head", *WORKERS]) as hosts, tempfile.TemporaryDirectory() as folder:
            run(Path(folder), hosts)
    except CoopError as error:
        sys.exit(f"dask-test: error: {error}")


if __name__ == "__main__":
    main()
