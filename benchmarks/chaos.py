"""`python benchmarks/chaos.py` kills roles of a `coop-local` run at random moments and counts the losses."""

from __future__ import annotations

import os
import random
import re
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from coop.common.errors import RunError, UsageError
from coop.common.messaging.transport import new_incarnation
from coop.common.process import cli
from coop.common.process.lifecycle import run_main
from coop.common.process.processes import ChildProcess, command, free_endpoint
from coop.monitor.watch import RunStatus
from coop.records.summaries import read_summary

TICK = 0.05  # seconds
ROLES = ("coop-learner", "coop-replay", "coop-actor")
SETTLED = 100  # minimum number of updates between two kills, so that each kill hits a working run


@dataclass(frozen=True)
class ChaosOptions:
    """Flags of `benchmarks/chaos.py`."""

    run_dir: Path
    """Folder for the run's files; must be new."""
    kills: int = 20
    """Number of processes to kill with SIGKILL."""
    actors: int = 2
    """Actor processes."""
    total_steps: int = 50_000
    """Environment steps of the run."""
    checkpoint_every: int = 500
    """Updates between checkpoints."""
    seed: int = 0
    """Seed of the run, and of the times and targets of the kills."""
    longest_pause: float = 3.0
    """Longest time, in seconds, between the run's recovery and the next kill."""
    give_up: float = 1200.0
    """Seconds after which the run counts as hanging."""


class ChaosMonkey:
    """Kills one role after another, each kind equally often, once the run works again.

    kills: number of kills by command. longest_stall: longest time without a step or an update, in seconds.
    """

    def __init__(self, options: ChaosOptions, supervisor: int, status: RunStatus) -> None:
        self.kills: dict[str, int] = dict.fromkeys(ROLES, 0)
        self.longest_stall = 0.0
        self._options = options
        self._supervisor = supervisor
        self._status = status
        self._chance = random.Random(options.seed)
        self._left = [ROLES[number % len(ROLES)] for number in range(options.kills)]
        self._chance.shuffle(self._left)
        self._progress = (0, 0)
        self._moved = time.monotonic()
        self._at_work_since = 0
        self._next = float("inf")

    def turn(self) -> None:
        """Check the run's progress, and kill a role if it is time."""
        now = time.monotonic()
        self._status.refresh()
        learner = self._status.learner
        progress = (0, 0) if learner is None else (learner.env_steps, learner.updates)
        if progress != self._progress:
            if self._progress[1]:
                self.longest_stall = max(self.longest_stall, now - self._moved)
            self._progress, self._moved = progress, now
        if not self._left:
            return
        updates = progress[1]
        self._at_work_since = min(self._at_work_since, updates)  # the learner may have returned to a checkpoint
        if self._next == float("inf") and updates >= self._at_work_since + SETTLED:
            self._next = now + self._chance.uniform(0, self._options.longest_pause)
        if now >= self._next and self._kill(self._left[-1]):
            self._left.pop()
            self._next, self._at_work_since = float("inf"), updates

    def _kill(self, name: str) -> bool:
        alive = [pid for pid, found in children(self._supervisor) if found == name]
        if not alive:
            return False
        os.kill(self._chance.choice(alive), signal.SIGKILL)
        self.kills[name] += 1
        return True


def children(pid: int) -> list[tuple[int, str]]:
    """(process id, command) of the direct children of a process that are roles."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            name, _, rest = (entry / "stat").read_text().partition("(")[2].rpartition(")")
            if int(rest.split()[1]) == pid and name in ROLES:
                found.append((int(entry.name), name))
    return found


def _repeated(printed: str) -> str:
    """How many transitions of the closing table are there twice, from what coop-reexecute has printed."""
    found = re.search(r"([\d,]+) of ([\d,]+) in the closing table", printed)
    if found is None:
        raise RunError(f"coop-reexecute does not tell of the closing table: {printed.strip()}")
    return f"{found[1]} of {found[2]}"


def main() -> None:
    """Entry point."""
    run_main("chaos", _run)


def _run() -> None:
    options = cli.parse(ChaosOptions, "chaos", "Kill roles of a run at random moments, and count what is lost.")
    if options.run_dir.exists():
        raise UsageError(f"--run-dir {options.run_dir}: exists already; give a new folder")
    options.run_dir.mkdir(parents=True)
    endpoint = free_endpoint()
    log = options.run_dir / "coop-local.log"
    flags = {
        "preset": "cartpole",
        "run-dir": options.run_dir,
        "listen": endpoint,
        "run": "chaos",
        "actors": options.actors,
        "seed": options.seed,
        "learner.mirror": "on",
        "total-steps": options.total_steps,
        "checkpoint-every": options.checkpoint_every,
        "replay.capacity": options.total_steps,  # the closing table shows what came in twice at any time
    }
    settings = (f"--{name}={value}" for name, value in flags.items())
    local = command("coop-local", *settings, "--replay.journal", "--replay.journal-keep")
    process = ChildProcess("coop-local", local, log)
    process.start()
    started = time.monotonic()
    status = RunStatus("chaos", endpoint, new_incarnation())
    try:
        monkey = ChaosMonkey(options, process.pid, status)
        while process.exit_status() is None:
            monkey.turn()
            time.sleep(TICK)
            if time.monotonic() > started + options.give_up:
                raise RunError(f"the run still goes on after {options.give_up:g} s: {status.line()}")
    finally:
        status.close()
        process.interrupt()
        process.end(60)
    ended = time.monotonic()
    if process.exit_status():
        raise RunError(process.why())
    proof = options.run_dir / "coop-reexecute.log"
    process = ChildProcess("coop-reexecute", command("coop-reexecute", str(options.run_dir)), proof)
    process.start()
    process.end(options.give_up)
    if process.exit_status():
        raise RunError(process.why())
    printed = proof.read_text(encoding="utf-8").strip()
    summary = read_summary(options.run_dir)
    killed = ", ".join(f"{count} {name.removeprefix('coop-')}" for name, count in monkey.kills.items())
    restarts = log.read_text(encoding="utf-8").count("starting it again")
    for name, value in {
        "kills": f"{sum(monkey.kills.values())} ({killed})",
        "transitions accepted": f"{summary['transitions_accepted']:,}",
        "lost": summary["transitions_lost"],
        "duplicated": _repeated(printed),
        "restarts": restarts,
        "longest stall": f"{monkey.longest_stall:.1f} s",
        "wall time": f"{ended - started:.0f} s",
        "re-executed": printed,
    }.items():
        print(f"{name:22}{value}")


if __name__ == "__main__":
    main()
