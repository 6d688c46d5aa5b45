"""Processor time of a run's parts: `python benchmarks/costs.py cartpole catch breakout-small`.

A run of each preset with one actor, its roles as real processes: first without the actor, then at the preset's replay
ratio, where the learner is busy all the time, then at a ratio so low that the actor is. The processor time of the three
processes in the phases gives the cost of an update, of a step, and of the replay service's inserts and draws. Prints a
line of milliseconds and of resident memory for each preset.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from roles import Roles, RunWatch, replay_stats, running, wait_until
from soak import measure

from coop.common.errors import CoopError
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.processes import command, free_endpoint

RUN = "costs"
FEW = "0.01"  # updates per step
FLAGS = ("--total-steps=1000000000", "--replay.capacity=20000", "--replay.learning-starts=1000")
NAMES = ("learner", "replay", "actor 1")


@dataclass(frozen=True)
class Phase:
    """Counts of a phase, and the seconds of processor time that each process took."""

    inserted: int
    drawn: int
    seconds: dict[str, float]


class Meter:
    """Reads the counters and the processor time of a run."""

    def __init__(self, roles: Roles, node: Node) -> None:
        self._roles, self._node = roles, node

    def phase(self, seconds: float) -> Phase:
        """What happens in the next seconds."""
        before, began = replay_stats(self._node), self._seconds()
        time.sleep(seconds)
        after, ended = replay_stats(self._node), self._seconds()
        taken = {name: ended[name] - began[name] for name in NAMES}
        return Phase(after.inserted - before.inserted, after.drawn - before.drawn, taken)

    def memory(self) -> dict[str, float]:
        """Resident MiB of each process."""
        return {name: measure(self._roles.processes[name].pid)["MiB"] for name in NAMES}

    def _seconds(self) -> dict[str, float]:
        return {name: processor_seconds(self._roles.processes[name].pid) for name in NAMES}


def processor_seconds(pid: int) -> float:
    """What a process has taken so far; 0 before its start, where the id is 0."""
    if not pid:
        return 0.0
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measured(preset: str, method: str, seconds: float) -> tuple[list[Phase], dict[str, float]]:
    """The phases in which nobody is busy, the learner is, and the actor is; and the memory of the processes."""
    at = free_endpoint(), free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        roles = Roles.of_run(Path(folder), RUN, at, (f"--preset={preset}", f"--method={method}", *FLAGS), actors=1)
        with (
            running(roles, "actor 1"),
            RunWatch(RUN, at[0]) as watch,
            Node(open_session((), at), RUN, "watch", new_incarnation()) as node,
        ):
            meter = Meter(roles, node)
            wait_until("the replay service", lambda: bool(node.presence.members("replay")), 120)
            time.sleep(1)
            idle = meter.phase(seconds)
            roles.processes["actor 1"].start()
            wait_until("updates", lambda: watch.updates() > 50, 120)
            learning = meter.phase(seconds)
            limits = command("coop-limits", f"--run={RUN}", "--connect", at[0], f"--ratio={FEW}")
            subprocess.run(limits, stdout=subprocess.DEVNULL, check=True)
            time.sleep(1)
            return [idle, learning, meter.phase(seconds)], meter.memory()


def main() -> None:
    """Print a line for each preset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("presets", nargs="+")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each phase")
    options = parser.parse_args()
    print(f"{'preset':24}{'step':>8}{'dqn':>8}{'coop':>8}{'insert':>9}{'draw':>8}   MiB of {', '.join(NAMES)}")
    try:
        for preset in options.presets:
            phases: list[Phase] = []
            updates = {}
            for method in ("dqn", "coop"):
                (idle, learning, acting), memory = measured(preset, method, options.seconds)
                phases += [idle, learning, acting]
                updates[method] = learning.seconds["learner"] / learning.drawn
            steps = sum(phase.seconds["actor 1"] for phase in phases[2::3]) / sum(p.inserted for p in phases[2::3])
            counts = np.array([(phase.inserted, phase.drawn, options.seconds) for phase in phases])
            taken = np.array([phase.seconds["replay"] for phase in phases])
            insert, draw, _ = np.linalg.lstsq(counts, taken, rcond=None)[0]  # the third: for a second without either
            costs = (f"{1000 * steps:8.3f}", *(f"{1000 * updates[method]:8.3f}" for method in updates))
            held = ", ".join(f"{memory[name]:.0f}" for name in NAMES)
            print(f"{preset:24}{''.join(costs)}{1000 * insert:9.4f}{1000 * draw:8.3f}   {held}", flush=True)
    except CoopError as error:
        sys.exit(f"costs: error: {error}")


if __name__ == "__main__":
    main()
