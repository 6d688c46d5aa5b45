"""The console commands. Their imports take seconds, during which a signal ends the process at once."""

from __future__ import annotations

import importlib

from common.process.importing import importing
from common.process.lifecycle import end_on_signals
from common.process.threads import despite_threads


def actor() -> None:
    """`coop-actor`."""
    _begin("coop-actor", "actors.cli")


def export() -> None:
    """`coop-export`."""
    _begin("coop-export", "experiments.export_cli")


def learner() -> None:
    """`coop-learner`."""
    _begin("coop-learner", "learner.cli")


def local() -> None:
    """`coop-local`."""
    _begin("coop-local", "deploy.local")


def lockstep() -> None:
    """`coop-lockstep`."""
    _begin("coop-lockstep", "experiments.lockstep_cli")


def replay() -> None:
    """`coop-replay`."""
    _begin("coop-replay", "replay.cli")


def sweep() -> None:
    """`coop-sweep`."""
    _begin("coop-sweep", "experiments.sweep.cli")


def _begin(program: str, module: str) -> None:
    end_on_signals(program)
    with importing():
        main = importlib.import_module(module).main
    with despite_threads():
        main()
