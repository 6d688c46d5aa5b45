"""`coop-lockstep`: one run of Algorithm 1 in one process."""

from __future__ import annotations

import sys
import time

from common.errors import RunError
from common.process.console import say
from common.process.lifecycle import Stop, run_main
from common.process.locks import RunLock
from common.process.threads import use_threads
from common.settings.options import RunOptions, beginning, parse_run
from experiments.lockstep import Lockstep
from learner.records.epochs import newest_epoch
from learner.records.run_directory import RunDirectory
from learner.records.summary import Summary, summarise

PROGRESS_EVERY = 5.0  # seconds


def main() -> None:
    """Entry point."""
    run_main("coop-lockstep", _run)


def _run() -> None:
    description = "Run Algorithm 1 exactly, in one process without a network."
    options = parse_run(RunOptions, "coop-lockstep", description, lockstep=True)
    config = options.run_config()
    use_threads(config.learner.threads)
    path = options.directory()
    stop = Stop()
    stop.on_signals()
    run = Lockstep(config)
    with RunLock(path, "coop-lockstep", ("learner", "replay")):
        epoch = newest_epoch(path) if options.resume else None
        if options.resume:
            print(beginning(path) if epoch is None else f"goes on from epoch {epoch.name}", flush=True)
        sizes = None if epoch is None else run.restore(epoch)
        with RunDirectory(path, config, sizes) as directory:
            summary = run_lockstep(run, directory, stop)
    run.env.close()
    say(f"{summary}; {path}")
    if run.trainer.diverged:
        raise RunError(run.trainer.diverged)
    if summary.exit == stop.reason:  # otherwise the run was complete before the signal
        stop.leave()


def run_lockstep(run: Lockstep, directory: RunDirectory, stop: Stop) -> Summary:
    """Play until the run is over or stopped, and complete its files; prints its progress every few seconds.

    Raises:
        RunError: there is no space for the closing epoch or the summary.
    """
    trainer, due = run.trainer, time.monotonic() + PROGRESS_EVERY
    while not (outcome := stop.reason if stop.is_set() else trainer.outcome()):
        for effects in run.play():
            directory.record(effects.episodes, effects.metrics)
        if trainer.epoch_due() and not trainer.outcome():
            trainer.epoch_begun()
            try:
                run.save(directory)
            except RunError as error:
                say(f"{error}; the run goes on without it")
        if time.monotonic() >= due:
            due = time.monotonic() + PROGRESS_EVERY
            say(_progress(run), end="\r" if sys.stdout.isatty() else "\n")
    outcome = trainer.diverged or outcome
    try:
        if trainer.saveable():
            run.save(directory)
    except RunError as error:
        outcome = f"failed: {error}"
        raise
    finally:
        summary = summarise(trainer, outcome, time.monotonic(), run.step)
        directory.conclude(summary, f"{summary.title}, lockstep")
    return summary


def _progress(run: Lockstep) -> str:
    telemetry = run.trainer.telemetry
    returns = f"return {telemetry.return_mean:.1f}" if telemetry.episodes else "no episode has ended yet"
    warning = telemetry.warning(run.agent)
    return f"step {run.step:,}/{run.config.total_steps:,}  {returns}" + (f"  [{warning}]" if warning else "")
