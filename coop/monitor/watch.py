"""`coop-watch`: the live status of a run, from any machine that reaches its learner."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from coop.common.errors import JoinError, PeerLost, UsageError
from coop.common.messaging.messages.status import LearnerStatus
from coop.common.messaging.transport import new_incarnation
from coop.common.numbers import strict_json
from coop.common.process.cli import parse
from coop.common.process.flags import HttpAddress
from coop.common.process.lifecycle import Stop, run_main
from coop.common.process.untrusted import check_run
from coop.monitor.screen import RunScreen
from coop.monitor.status import Display, RunStatus, live_page

TICK = 0.1  # seconds


@dataclass(frozen=True)
class WatchOptions:
    """Flags of `coop-watch`."""

    run: str = "coop"
    """Name of the run."""
    connect: str = "tcp/127.0.0.1:7447"
    """Endpoint of the learner, for example tcp/head:7447."""
    join_timeout: float = 30.0
    """Seconds to search for the learner before giving up."""
    patience: float = 60.0
    """Seconds to wait for a lost learner before giving up."""
    zenoh_config: Path | None = None
    """A Zenoh configuration file (TLS, access control); the endpoint given as a flag still applies."""
    once: bool = False
    """Print the present status and end."""
    web: HttpAddress = ""
    """Show the screen as a web page too: PORT, on loopback, or HOST:PORT."""
    json: bool = False
    """With --once: print one JSON object instead of the screen; docs/watching.md lists its fields."""

    def __post_init__(self) -> None:
        """Raise UsageError for a name that no run has."""
        check_run(self.run)


def main() -> None:
    """Entry point."""
    run_main("coop-watch", _run)


def _run() -> None:
    options = parse(WatchOptions, "coop-watch", "Show the live status of a run until it ends.")
    if options.json and not options.once:
        raise UsageError("--json: needs --once")
    if options.web and options.once:
        raise UsageError("--web: shows a live run; leave out --once")
    ctrl_c = Stop()
    ctrl_c.on_signals()
    status = RunStatus(options.run, options.connect, new_incarnation(), options.zenoh_config)
    try:
        if options.once:
            _print_once(status, options, ctrl_c)
        else:
            _follow(status, options, ctrl_c)
    finally:
        status.close()


def _follow(status: RunStatus, options: WatchOptions, ctrl_c: Stop) -> None:
    """Show the status until the run ends."""
    ended = Stop()
    status.follow_stop(ended)
    with live_page(options.run, options.web) as page, Display(status, page) as display:
        while not ended.is_set() and not ctrl_c.wait(TICK):
            display.update()
            _check(status, options)
        if status.learner is not None:
            display.say(status.line())
        if ended.is_set():
            display.say(f"the run has ended: {ended.reason}")


def _print_once(status: RunStatus, options: WatchOptions, ctrl_c: Stop) -> None:
    """Wait for a status, and print it."""
    while status.learner is None:
        if ctrl_c.wait(TICK):
            ctrl_c.leave()
        status.refresh()
        _check(status, options)
    if options.json:
        print(strict_json(report(status.run, status.learner)))
    else:
        lines = [line for _, line in status.events()]
        Console().print(RunScreen(status.run, status.learner, lines, whole=True))


def report(run: str, status: LearnerStatus) -> dict[str, Any]:
    """The status as plain values: `LearnerStatus`'s fields, with the run's name, and of the events the lines alone."""
    return {"run": run, **msgspec.to_builtins(status), "events": [line for _, line in status.events]}


def _check(status: RunStatus, options: WatchOptions) -> None:
    """Raise JoinError or PeerLost if the learner has been silent for too long."""
    silent = status.silent_for()
    if status.learner is None and silent > options.join_timeout:
        raise JoinError(status.why_nothing(options.join_timeout))
    if status.learner is not None and silent > options.patience:
        raise PeerLost(f"the learner of run {options.run!r} has been silent for {options.patience:g} s")
