"""`coop-lockstep`: one run of Algorithm 1 in one process."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing

from coop.common.errors import RunError
from coop.common.imports import importing
from coop.common.places import shown
from coop.common.process.console import say
from coop.common.process.lifecycle import Stop, run_main
from coop.common.process.output import out
from coop.records.run_options import RunOptions, parse_run

REPLAY_PROGRESS_EVERY = 5.0  # seconds


def main() -> None:
    """Entry point."""
    run_main("coop-lockstep", _run)


def _run() -> None:
    description = "Run Algorithm 1 exactly, in one process without a network."
    options = parse_run(RunOptions, "coop-lockstep", description, lockstep=True)
    config = options.run_config()
    path = options.directory()
    with importing():
        from coop.lockstep.run import LockstepRun  # noqa: PLC0415 (torch takes seconds; wrong flags should not)

    stop = Stop()
    stop.on_signals()
    replaying = _replaying(stop)
    opened = LockstepRun(config, path, "coop-lockstep", options.start, log=options.log, replaying=replaying)
    with closing(opened) as run:
        for line in (*run.notices, options.settings):
            say(line)
        summary = run.play(stop, _progress)
    stopped = summary.exit == stop.reason  # otherwise the run was complete before the signal
    there = shown(path)
    say(f"{summary}; coop-lockstep --resume --run-dir {there} goes on" if stopped else f"{summary}; {there}")
    if run.diverged:
        raise RunError(run.diverged)
    if stopped:
        stop.raise_for_status()


def _progress(line: str) -> None:
    stream = out()
    say(line, end="\r" if stream is not None and stream.isatty() else "\n")


def _replaying(stop: Stop) -> Callable[[int, int], None]:
    """Follows the actions that a resumed run plays again: a line every few seconds, and an end on a signal."""
    due = time.monotonic() + REPLAY_PROGRESS_EVERY

    def replaying(played: int, actions: int) -> None:
        nonlocal due
        if stop.is_set():
            say("interrupted before the run went on; its files are as they were")
            stop.raise_for_status()
        if time.monotonic() >= due:
            due = time.monotonic() + REPLAY_PROGRESS_EVERY
            _progress(f"plays the run's actions again: {played:,}/{actions:,}")

    return replaying
