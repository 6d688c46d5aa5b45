"""`coop-watch`: the live status of a run, from any machine that reaches its learner."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from common.errors import JoinError, PeerLost
from common.messaging.transport import new_incarnation
from common.process.cli import parse
from common.process.lifecycle import Stop, run_main
from deploy.status import Display, RunStatus

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


def main() -> None:
    """Entry point."""
    run_main("coop-watch", _run)


def _run() -> None:
    options = parse(WatchOptions, "coop-watch", "Show the live status of a run until it ends.")
    ctrl_c, ended = Stop(), Stop()
    ctrl_c.on_signals()
    status = RunStatus(options.run, options.connect, new_incarnation(), options.zenoh_config)
    status.follow_stop(ended)
    try:
        with Display(status) as display:
            while not ended.is_set() and not ctrl_c.wait(TICK):
                display.update()
                _check(status, options)
            if status.learner:
                display.say(status.line())
            if ended.is_set():
                display.say(f"the run has ended: {ended.reason}")
    finally:
        status.close()


def _check(status: RunStatus, options: WatchOptions) -> None:
    """Raise JoinError or PeerLost if the learner has been silent for too long."""
    silent = status.silent_for()
    if not status.learner and silent > options.join_timeout:
        where = f"found at {options.connect} within {options.join_timeout:g} s"
        raise JoinError(f"no learner of run {options.run!r} {where}")
    if status.learner and silent > options.patience:
        raise PeerLost(f"the learner of run {options.run!r} has been silent for {options.patience:g} s")
