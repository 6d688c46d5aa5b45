"""`coop-router`: one address for any number of actors, each of which then needs a single link."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import zenoh

from coop.common.messaging.links import close, described
from coop.common.messaging.session import open_session
from coop.common.process import cli
from coop.common.process.console import Console, counted
from coop.common.process.lifecycle import Stop, run_main
from coop.common.settings.options import HealthOptions
from coop.monitor.health import answering

TICK = 0.5  # seconds


@dataclass(frozen=True)
class RouterOptions(HealthOptions):
    """Flags of `coop-router`."""

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints of the learner; the replay service connects to the router itself, with a second --connect."""
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7449",)
    """Endpoints to listen on."""
    zenoh_config: Path | None = None
    """A Zenoh configuration file (TLS, access control); the endpoints given as flags still apply."""


def main() -> None:
    """Entry point."""
    run_main("coop-router", _run)


def _run() -> None:
    options = cli.parse(RouterOptions, "coop-router", "Forward between a run's services and actors in client mode.")
    stop, console = Stop(), Console()
    stop.on_signals()
    session = open_session(options.listen, options.connect, options.zenoh_config, mode="router")
    try:
        with answering(options.health, console):
            console.event(f"router listens on {', '.join(options.listen)}")
            while not stop.wait(TICK):
                console.progress(0, "", lambda: links(session))
    finally:
        close(session)
    stop.raise_for_status()


def links(session: zenoh.Session) -> str:
    """How many services and actors are connected to a router, in words."""
    kinds = [link["whatami"] for link in described(session, "router").get("sessions", ())]
    return f"connected: {counted(kinds.count('peer'), 'service')}, {counted(kinds.count('client'), 'actor')}"
