"""Starts, queries and ends the roles of a run for the other scripts in this folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import zenoh

from common.errors import RunError
from common.messaging import wire
from common.messaging.keys import replay_key
from common.messaging.messages.stats import ReplayStats, StatsQuestion
from common.messaging.transport import Node
from common.process.processes import ChildProcess, command
from common.process.summaries import read_summary

GRACE = 60.0  # seconds for a role to end


class Roles:
    """The processes of one run, by name: learner, replay, actor 1, actor 2 and so on.

    Args:
        folder: run directory; logs go to its logs/.
        at: endpoints of learner and replay service.
        inside: command prefix of a role ("ip netns exec NAME"), by the role's first word.
    """

    def __init__(
        self,
        folder: Path,
        run: str,
        at: tuple[str, str],
        flags: Sequence[str],
        actors: int,
        inside: Callable[[str], list[str]] = lambda role: [],
    ) -> None:
        logs = folder / "logs"
        logs.mkdir(parents=True)
        self.folder = folder
        learner_at, replay_at = at
        joining = (f"--run={run}", "--connect", learner_at, "--join-timeout=60")
        own = {
            "learner": (f"--run={run}", f"--run-dir={folder}", "--listen", learner_at, *flags),
            "replay": (*joining, "--listen", replay_at, f"--run-dir={folder}"),
            **{f"actor {number + 1}": joining for number in range(actors)},
        }
        self.processes = {
            name: ChildProcess(
                name,
                [*inside(name.split()[0]), *command(f"coop-{name.split()[0]}", *arguments)],
                logs / f"{name.replace(' ', '-')}.log",
            )
            for name, arguments in own.items()
        }

    def check(self, *names: str) -> None:
        """Raise RunError if one of these processes has ended."""
        for name in names:
            if self.processes[name].exit_status() is not None:
                raise RunError(self.processes[name].why())

    def finish(self) -> dict[str, Any]:
        """Interrupt the learner, wait for all roles, and return the run's summary.

        Raises:
            RunError: a role failed.
        """
        self.processes["learner"].interrupt()
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


class ActorWatch:
    """The number of acknowledged transitions of each actor, by its own account.

    Actors publish it to the learner, which forwards it to its Zenoh clients, like this one.
    """

    def __init__(self, run: str, learner_at: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([learner_at]))
        config.insert_json5("connect/timeout_ms", "-1")
        self._run = run
        self._session = zenoh.open(config)
        self._acked: dict[str, int] = {}
        self._told = self._session.declare_subscriber(f"coop/{run}/metrics/actor/*", zenoh.handlers.FifoChannel(256))

    def acked(self) -> dict[str, int]:
        """The latest numbers, by incarnation."""
        while (sample := self._told.try_recv()) is not None:
            self._acked[str(sample.key_expr)] = wire.decode(sample.payload.to_bytes()).fields["acked"]
        return dict(self._acked)

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
