"""Starts, queries and ends the roles of a run for the other scripts in this folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import zenoh

from coop.common.errors import RunError
from coop.common.messaging import wire
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.status import ReplayStats, StatsQuestion
from coop.common.messaging.transport import Node
from coop.common.process.processes import ChildProcess, command
from coop.records.summaries import read_summary

GRACE = 60.0  # seconds for a role to end


class Roles:
    """The processes of one run, by name: learner, replay, actor 1, actor 2 and so on.

    Args:
        folder: run directory; logs go to its logs/.
        flags: of each process.
        inside: command prefix of a process ("ip netns exec NAME"), by its name.
    """

    def __init__(
        self,
        folder: Path,
        flags: Mapping[str, Sequence[str]],
        inside: Callable[[str], list[str]] = lambda name: [],
    ) -> None:
        self.folder = folder
        self._inside = inside
        (folder / "logs").mkdir(parents=True)
        self.processes = {name: self._process(name, own) for name, own in flags.items()}

    @classmethod
    def of_run(cls, folder: Path, run: str, at: tuple[str, str], flags: Sequence[str], actors: int) -> Self:
        """A run whose learner, with these flags, and replay service have the endpoints `at`."""
        learner_at, replay_at = at
        joining = (f"--run={run}", "--connect", learner_at, "--join-timeout=60")
        own = {
            "learner": (f"--run={run}", f"--run-dir={folder}", "--listen", learner_at, *flags),
            "replay": (*joining, "--listen", replay_at, f"--run-dir={folder}"),
            **{f"actor {number + 1}": joining for number in range(actors)},
        }
        return cls(folder, own)

    def _process(self, name: str, flags: Sequence[str]) -> ChildProcess:
        arguments = [*self._inside(name), *command(f"coop-{name.split(maxsplit=1)[0]}", *flags)]
        return ChildProcess(name, arguments, self.folder / "logs" / f"{name.replace(' ', '-')}.log")

    def start_again(self, name: str, flags: Sequence[str]) -> None:
        """Start a process that has ended, with other flags."""
        self.processes[name] = self._process(name, flags)
        self.processes[name].start()

    def check(self, *names: str) -> None:
        """Raise RunError if one of these processes has ended."""
        for name in names:
            if self.processes[name].exit_status() is not None:
                raise RunError(self.processes[name].why())

    def finish(self) -> dict[str, Any]:
        """Interrupt the learner, and return as `ended`."""
        self.processes["learner"].interrupt()
        return self.ended()

    def ended(self) -> dict[str, Any]:
        """Wait for the end of all roles, and return the run's summary.

        Raises:
            RunError: a role failed.
        """
        for process in self.processes.values():
            process.end(GRACE)
            if process.exit_status() and not process.was_interrupted():
                raise RunError(process.why())
        return read_summary(self.folder)


@contextmanager
def running(roles: Roles, *later: str) -> Iterator[Roles]:
    """Start every role except those that come `later`; kill the remaining ones at the end."""
    try:
        for name, process in roles.processes.items():
            if name not in later:
                process.start()
        yield roles
    finally:
        for process in roles.processes.values():
            process.end(0.0)


class RunWatch:
    """The progress of a run's learner and actors, by their own account.

    Actors publish theirs to the learner, which forwards it to its Zenoh clients, like this one.
    """

    def __init__(self, run: str, learner_at: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([learner_at]))
        config.insert_json5("connect/timeout_ms", "-1")
        self._session = zenoh.open(config)
        self._fields: dict[str, dict[str, Any]] = {}
        self._statuses = self._session.declare_subscriber(f"coop/{run}/metrics/*/*", zenoh.handlers.RingChannel(256))

    def acked(self) -> dict[str, int]:
        """The latest number of acknowledged transitions of each actor, by incarnation."""
        return {key: fields["acked"] for key, fields in self._read("actor").items()}

    def updates(self) -> int:
        """The learner's latest number of updates; 0 before its first word."""
        return max((fields["updates"] for fields in self._read("learner").values()), default=0)

    def _read(self, role: str) -> dict[str, dict[str, Any]]:
        """The latest status of each process of a role, by key."""
        while (sample := self._statuses.try_recv()) is not None:
            self._fields[str(sample.key_expr)] = wire.decode(sample.payload.to_bytes()).fields
        return {key: fields for key, fields in self._fields.items() if key.split("/")[-2] == role}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()


def replay_stats(node: Node, timeout: float = 5.0) -> ReplayStats:
    """The replay service's counters; raises as `Node.ask`."""
    question = StatsQuestion().encode(node.run)
    return ReplayStats.decode(node.ask(replay_key(node, "stats"), question, timeout))


def wait_until(what: str, reached: Callable[[], bool], seconds: float = 60.0) -> float:
    """Wait until `reached` is true; return the seconds that it took.

    Raises:
        RunError: it did not become true within `seconds`.
    """
    began = time.monotonic()
    while not reached():
        if time.monotonic() - began > seconds:
            raise RunError(f"{what}: not within {seconds:g} s")
        time.sleep(0.05)
    return time.monotonic() - began
