"""The console commands: what each process sets up before anything else, and the imports, which take seconds."""

from __future__ import annotations

import importlib

from common.places import remember_working_directory
from common.process.importing import importing
from common.process.lifecycle import despite_threads, end_on_signals
from common.process.limits import limit_threads
from common.process.output import take_standard_files


def actor() -> None:
    """`coop-actor`."""
    _begin("coop-actor", "actors.cli")


def evaluate() -> None:
    """`coop-eval`."""
    _begin("coop-eval", "experiments.evaluation_cli")


def export() -> None:
    """`coop-export`."""
    _begin("coop-export", "experiments.export_cli")


def learner() -> None:
    """`coop-learner`."""
    _begin("coop-learner", "learner.cli")


def limits() -> None:
    """`coop-limits`."""
    _begin("coop-limits", "replay.limits_cli")


def local() -> None:
    """`coop-local`."""
    _begin("coop-local", "deploy.local")


def lockstep() -> None:
    """`coop-lockstep`."""
    _begin("coop-lockstep", "experiments.lockstep_cli")


def reexecute() -> None:
    """`coop-reexecute`."""
    _begin("coop-reexecute", "experiments.reexecute_cli")


def replay() -> None:
    """`coop-replay`."""
    _begin("coop-replay", "replay.cli")


def report() -> None:
    """`coop-report`."""
    _begin("coop-report", "experiments.report.cli")


def router() -> None:
    """`coop-router`."""
    _begin("coop-router", "deploy.router")


def sweep() -> None:
    """`coop-sweep`."""
    _begin("coop-sweep", "experiments.sweep.cli")


def watch() -> None:
    """`coop-watch`."""
    _begin("coop-watch", "deploy.watch")


def _begin(program: str, module: str) -> None:
    take_standard_files()  # first: what is opened before it may take the number of one that is closed
    remember_working_directory()
    end_on_signals(program)
    limit_threads()
    with importing():
        main = importlib.import_module(module).main
    with despite_threads():
        main()
