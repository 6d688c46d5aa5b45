"""The cost of the journal: `python benchmarks/journal.py` inserts Atari segments without one, and with both kinds.

Real `coop-replay` processes on TCP, one inserting client with 100 segments in flight. The services take turns
for a second each, so that the ratios hold on a busy machine. Prints transitions/s and the processor time that the
service spent on them, which other load affects less. After each turn a checkpoint releases the journal's files.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import msgspec
from made_up import ATARI, segments

from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.control import Snapshot, Written
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import NoAnswer, Node, new_incarnation
from coop.common.process.lifecycle import Stop
from coop.common.process.memory import keep_freed_memory
from coop.common.process.processes import ChildProcess, command, free_endpoint
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import validated
from coop.learner.join_service import JoinService
from coop.learner.roster import Roster
from coop.learner.shared_checkpoints import SharedCheckpoints

STEPS, WINDOW, CAPACITY = 16, 100, 5000
KINDS = ("off", "async", "sync")
TICKS = os.sysconf("SC_CLK_TCK")


def settings(run: str, journal: str) -> RunConfig:
    """Of a run that waits for no batches."""
    replay = {"capacity": CAPACITY, "learning_starts": 1000, "tolerance": 1e12, "journal": journal}
    return validated({"run": run, "total_steps": 10**12, "env": {"id": "breakout"}, "replay": replay})


class Service:
    """A replay service and a client of it."""

    def __init__(self, stack: ExitStack, journal: str, folder: Path) -> None:
        run = f"journal-{journal}"
        config = settings(run, journal)
        head, at = free_endpoint(), free_endpoint()
        learner = stack.enter_context(Node(open_session((head,)), run, "learner", new_incarnation()))
        JoinService(
            learner,
            config,
            ATARI,
            "",
            run_id=0,
            shared=SharedCheckpoints([], "benchmark"),
            roster=Roster(),
            event=print,
        )
        flags = ("--run", run, "--connect", head, "--listen", at, "--run-dir", str(folder))
        self._process = ChildProcess("replay", command("coop-replay", *flags), folder.with_suffix(".log"))
        self._process.start()
        stack.callback(self._process.end, 20)
        stack.callback(self._process.interrupt)
        incarnation = new_incarnation()
        self._node = stack.enter_context(Node(open_session((), (at,)), run, "actor", incarnation))
        self._client = InsertClient(self._node, Stop(), WINDOW)
        self._stream = (msgspec.structs.replace(segment, incarnation=incarnation) for segment in segments(ATARI, STEPS))
        self._checkpoint = 0

    def insert(self, seconds: float, save: bool = True) -> tuple[float, float]:
        """Insert as fast as it goes: (transitions/s, the service's processor time in us per transition)."""
        before, begun, acked = self._processor_time(), time.monotonic(), self._client.acked
        while time.monotonic() < begun + seconds:
            self._client.submit(next(self._stream))
        self._client.drain()
        done, took = self._client.acked - acked, time.monotonic() - begun
        figures = done / took, 1e6 * (self._processor_time() - before) / done
        if save:
            self._save()
        return figures

    @property
    def acked(self) -> int:
        """Transitions acknowledged so far."""
        return self._client.acked

    @property
    def pid(self) -> int:
        """The process of the replay service."""
        return self._process.pid

    def _processor_time(self) -> float:
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    def _save(self) -> None:
        self._checkpoint += 1
        self._ask(Snapshot(self._checkpoint, [], 1, self._checkpoint).encode(self._node.run))
        while self._ask(Written(self._checkpoint).encode(self._node.run)) == "retry":
            pass

    def _ask(self, question: bytearray) -> str:
        while True:
            try:
                return self._node.ask(replay_key(self._node, "snapshot"), question, 30.0).kind
            except NoAnswer:
                time.sleep(0.1)


def shown(values: list[float], form: Callable[[float], str]) -> str:
    """Median (lowest to highest)."""
    return f"{form(statistics.median(values))} ({form(min(values))} to {form(max(values))})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each turn")
    options = parser.parse_args()
    keep_freed_memory()
    rounds = []
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        services = [Service(stack, journal, Path(folder) / journal) for journal in KINDS]
        for service in services:
            service.insert(1.0)
        for number in range(options.rounds):
            order = services if number % 2 else services[::-1]
            taken = {id(service): service.insert(options.seconds) for service in order}
            rounds.append([taken[id(service)] for service in services])
    print(f"{options.rounds} rounds of {options.seconds:g} s, segments of {STEPS} steps: median (lowest to highest)")
    for place, name in enumerate(KINDS):
        rates, costs = zip(*(turn[place] for turn in rounds), strict=True)
        print(f"{name:14}{shown(list(rates), '{:,.0f}'.format)} transitions/s", end=", ")
        print(f"{shown(list(costs), '{:.1f}'.format)} us of processor time each")
    for one, other in ((1, 0), (2, 0), (2, 1)):
        for what, index in (("transitions/s", 0), ("processor time", 1)):
            ratios = [turn[one][index] / turn[other][index] for turn in rounds]
            print(f"{KINDS[one]} / {KINDS[other]}, {what}: {shown(ratios, '{:.2f}'.format)}")


if __name__ == "__main__":
    main()
