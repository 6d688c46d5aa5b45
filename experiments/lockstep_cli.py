"""`coop-lockstep`: one run of Algorithm 1 in one process."""

from __future__ import annotations

import math
import sys
import time

from common.process.lifecycle import Stop, run_main
from common.process.threads import use_threads
from common.settings.options import RunOptions, parse_run
from experiments.lockstep import Lockstep, finish
from learner.records.epochs import newest_epoch
from learner.records.run_directory import RunDirectory
from learner.targets import target_reached

PROGRESS_EVERY = 5.0  # seconds


def main() -> None:
    """Entry point."""
    run_main("coop-lockstep", _run)


def _run() -> None:
    options = parse_run(RunOptions, "coop-lockstep", "Run Algorithm 1 exactly, in one process without a network.")
    config = options.run_config()
    use_threads(config.learner.threads)
    path = options.directory()
    stop = Stop()
    stop.on_signals()
    started = time.monotonic()
    run = Lockstep(config)
    epoch = newest_epoch(path) if options.resume else None
    sizes = None if epoch is None else run.restore(epoch)
    with RunDirectory(path, config, sizes) as directory:
        outcome = _play(run, directory, stop)
        summary = finish(run, directory, started, outcome)
    run.env.close()
    print(f"{summary}; {path}")


def _play(run: Lockstep, directory: RunDirectory, stop: Stop) -> str:
    """Play until the run is complete or stopped; why it ended."""
    config, due = run.config, time.monotonic() + PROGRESS_EVERY
    every = config.checkpoint_every or math.inf
    save_at = run.agent.updates + every
    while run.step < config.total_steps and not stop.is_set():
        if reached := target_reached(config, run.agent.updates, run.telemetry):
            return reached
        run.play(directory)
        if run.agent.updates >= save_at and run.step < config.total_steps:
            save_at += every
            run.save(directory)
        if time.monotonic() >= due:
            due = time.monotonic() + PROGRESS_EVERY
            known = run.telemetry.episodes > 0
            returns = f"return {run.telemetry.return_mean:.1f}" if known else "no episode has ended yet"
            text = f"step {run.step:,}/{config.total_steps:,}  {returns}"
            print(text, end="\r" if sys.stdout.isatty() else "\n", flush=True)
    return stop.reason or "complete"
