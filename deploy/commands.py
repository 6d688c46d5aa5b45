"""The console commands: what each process sets up before anything else, and the imports, which take seconds.

`python -m coop.deploy.commands coop-local ...` starts one where no scripts are installed.
"""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import TracebackType

from coop.common.imports import importing
from coop.common.places import remember_working_directory
from coop.common.process.lifecycle import despite_threads, end_on_signals
from coop.common.process.limits import limit_threads
from coop.common.process.output import take_standard_files

MODULES = {
    "coop-actor": "coop.actors.cli",
    "coop-eval": "coop.evaluation.cli",
    "coop-export": "coop.evaluation.export_cli",
    "coop-learner": "coop.learner.cli",
    "coop-limits": "coop.replay.limits_cli",
    "coop-local": "coop.deploy.local",
    "coop-lockstep": "coop.lockstep.cli",
    "coop-reexecute": "coop.lockstep.reexecute_cli",
    "coop-replay": "coop.replay.cli",
    "coop-report": "coop.studies.report.cli",
    "coop-router": "coop.deploy.router",
    "coop-sweep": "coop.studies.sweep.cli",
    "coop-watch": "coop.studies.watch.cli",
}


def _in_one_line(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print one line for a Ctrl-C that arrives during a command's imports, as for every later one."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


def main() -> None:
    """The command after which the script is named."""
    sys.excepthook = _in_one_line
    program = Path(sys.argv[0]).name
    if program not in MODULES:
        sys.exit(f"{program}: give one of {', '.join(MODULES)}")
    take_standard_files()  # first: what is opened before it may take the number of one that is closed
    remember_working_directory()
    end_on_signals(program)
    limit_threads()
    os.environ.pop("MPLBACKEND", None)  # of a notebook, or of no backend at all; a command draws to files only
    with importing():
        run = importlib.import_module(MODULES[program]).main
    with despite_threads():
        run()


if __name__ == "__main__":
    sys.argv = sys.argv[1:] or ["python -m coop.deploy.commands"]
    main()
