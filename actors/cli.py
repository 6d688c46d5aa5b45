"""`coop-actor`: one process of emulators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from coop.common.errors import UsageError
from coop.common.imports import importing
from coop.common.process import cli
from coop.common.process.lifecycle import run_main
from coop.common.settings.options import HealthOptions, RoleOptions


@dataclass(frozen=True)
class ActorOptions(RoleOptions, HealthOptions):
    """Flags of `coop-actor`."""

    mode: Literal["peer", "client"] = "peer"
    """client: --connect names a router, and this process has no other link."""
    envs: int | None = None
    """Emulators in this process; the run's actor.num_envs if not given."""
    device: str = "cpu"
    """Where the networks choose actions: cpu, cuda or cuda:1."""
    groups: int | None = None
    """Groups of emulators that act in turn, one while the others play; 2 with a GPU, else 1, if not given."""


def main() -> None:
    """Entry point."""
    run_main("coop-actor", _run)


def _run() -> None:
    options = cli.parse(ActorOptions, "coop-actor", "Play emulators for a run; its learner sends the config.")
    if options.groups is not None and options.groups < 1:
        raise UsageError(f"--groups: {options.groups} is not allowed; at least 1")
    with importing():
        from coop.actors.process import play  # noqa: PLC0415 (torch takes seconds; wrong flags should not)

    play(options)
