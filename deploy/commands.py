"""The console commands. Their imports take seconds, during which a signal ends the process at once.

`python -m deploy.commands coop-local ...` starts one where no scripts are installed.
"""

from __future__ import annotations

import importlib
import sys

from common.process.importing import importing
from common.process.lifecycle import end_on_signals


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


_MODULES = {
    "coop-actor": "actors.cli",
    "coop-eval": "experiments.evaluation_cli",
    "coop-export": "experiments.export_cli",
    "coop-learner": "learner.cli",
    "coop-limits": "replay.limits_cli",
    "coop-local": "deploy.local",
    "coop-lockstep": "experiments.lockstep_cli",
    "coop-plan": "deploy.plan",
    "coop-reexecute": "experiments.reexecute_cli",
    "coop-replay": "replay.cli",
    "coop-report": "experiments.report.cli",
    "coop-router": "deploy.router",
    "coop-sweep": "experiments.sweep.cli",
    "coop-watch": "deploy.watch",
}


def _begin(program: str, module: str) -> None:
    end_on_signals(program)
    with importing():
        main = importlib.import_module(module).main
    main()


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in _MODULES:
        sys.exit(f"python -m deploy.commands: give one of {', '.join(_MODULES)}")
    del sys.argv[0]
    _begin(sys.argv[0], _MODULES[sys.argv[0]])
