"""`coop-lockstep`: one run of Algorithm 1 in one process."""

from __future__ import annotations

import sys
from contextlib import closing

from common.errors import RunError
from common.process.console import say
from common.process.importing import importing
from common.process.lifecycle import Stop, run_main
from common.settings.options import RunOptions, beginning, parse_run


def main() -> None:
    """Entry point."""
    run_main("coop-lockstep", _run)


def _run() -> None:
    description = "Run Algorithm 1 exactly, in one process without a network."
    options = parse_run(RunOptions, "coop-lockstep", description, lockstep=True)
    config = options.run_config()
    path = options.directory()
    with importing():
        from experiments.lockstep_run import LockstepRun  # noqa: PLC0415 (torch takes seconds; wrong flags should not)

    stop = Stop()
    stop.on_signals()
    with closing(LockstepRun(config, path, "coop-lockstep", resume=options.resume, wandb=options.wandb)) as run:
        if options.resume:
            print(beginning(path) if run.epoch is None else f"goes on from epoch {run.epoch.name}", flush=True)
        summary = run.play(stop, lambda line: say(line, end="\r" if sys.stdout.isatty() else "\n"))
    stopped = summary.exit == stop.reason  # otherwise the run was complete before the signal
    say(f"{summary}; coop-lockstep --resume --run-dir {path} goes on" if stopped else f"{summary}; {path}")
    if run.diverged:
        raise RunError(run.diverged)
    if stopped:
        stop.leave()
