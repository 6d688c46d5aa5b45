"""The console commands: what each process sets up before anything else, and the imports, which take seconds.

`python -m deploy.commands coop-local ...` starts one where no scripts are installed.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from common.places import remember_working_directory
from common.process.importing import importing
from common.process.lifecycle import despite_threads, end_on_signals
from common.process.limits import limit_threads
from common.process.output import take_standard_files

MODULES = {
    "coop-actor": "actors.cli",
    "coop-eval": "experiments.evaluation_cli",
    "coop-export": "experiments.export_cli",
    "coop-learner": "learner.cli",
    "coop-limits": "replay.limits_cli",
    "coop-local": "deploy.local",
    "coop-lockstep": "experiments.lockstep_cli",
    "coop-reexecute": "experiments.reexecute_cli",
    "coop-replay": "replay.cli",
    "coop-report": "experiments.report.cli",
    "coop-router": "deploy.router",
    "coop-sweep": "experiments.sweep.cli",
    "coop-watch": "deploy.watch",
}


def main() -> None:
    """The command after which the script is named."""
    program = Path(sys.argv[0]).name
    if program not in MODULES:
        sys.exit(f"{program}: give one of {', '.join(MODULES)}")
    take_standard_files()  # first: what is opened before it may take the number of one that is closed
    remember_working_directory()
    end_on_signals(program)
    limit_threads()
    with importing():
        run = importlib.import_module(MODULES[program]).main
    with despite_threads():
        run()


if __name__ == "__main__":
    sys.argv = sys.argv[1:] or ["python -m deploy.commands"]
    main()
