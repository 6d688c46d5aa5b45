"""Lockstep runs side by side with their files, each in a directory of its own as `coop-lockstep` would leave it.

    python -m coop.studies.stacked.together runs/a runs/b runs/c

goes on with the runs of these directories, which hold a config.toml each. Each fails alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import groupby
from pathlib import Path

from coop.common.errors import CoopError, RunError, UsageError, first_line
from coop.common.process.console import say
from coop.common.process.lifecycle import Stop, run_main
from coop.common.settings.config import RunConfig
from coop.learner.summary import summarise
from coop.lockstep.lockstep import Lockstep
from coop.lockstep.memory import TableMemory
from coop.lockstep.run import PROGRESS_EVERY, LockstepRun
from coop.records.reading import read_run_config
from coop.records.resumption import Start
from coop.records.run_directory import RunDirectory
from coop.records.sinks import DEFAULT_LOG
from coop.records.summaries import Summary
from coop.studies.stacked.seeds import MOST, Seeds
from coop.studies.sweep.stacking import why_not

PROGRAM = "coop-lockstep"


def play_together(
    runs: Sequence[LockstepRun],
    stop: Stop,
    player: int | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> list[Summary]:
    """Play runs that differ in their seeds until each is over, or until the stop, and complete their files.

    Runs that are not equally far go on in groups, one after the other. player: see `Seeds`. progress: called with a
    line every few seconds.

    Raises:
        RunError: the files of some runs can't be completed; the others are.
    """
    summaries, failed = [], []
    with ExitStack() as stack:
        files = {run.run: stack.enter_context(run.files()) for run in runs}
        for run, directory in files.items():
            _align(run, directory)
        ordered = sorted(files, key=lambda run: run.step)
        for _, group in groupby(ordered, key=lambda run: run.step):
            done, problems = _Group(list(group), files, player).play(stop, progress)
            summaries += done
            failed += problems
    if failed:
        raise RunError("; ".join(failed))
    return summaries


def _align(run: Lockstep, directory: RunDirectory) -> None:
    """Play to the end of a segment, where a stop may have come before it."""
    while isinstance(run.memory, TableMemory) and run.memory.waiting and not run.trainer.outcome():
        for effects in run.play():
            directory.record(effects.episodes, effects.metrics)


class _Group:
    """Runs that are equally far."""

    def __init__(self, runs: list[Lockstep], files: dict[Lockstep, RunDirectory], player: int | None) -> None:
        self._runs, self._files = runs, files
        self._seeds = Seeds(runs, player)
        self._summaries: list[Summary] = []
        self._failed: list[str] = []

    def play(self, stop: Stop, progress: Callable[[str], None]) -> tuple[list[Summary], list[str]]:
        """Play to the end; returns the summaries, and what could not be completed."""
        seeds, due = self._seeds, time.monotonic() + PROGRESS_EVERY
        total = self._runs[0].config.total_steps
        outcome = "interrupted"
        try:
            while seeds.runs and seeds.step < total and not stop.is_set():
                self._block()
                if time.monotonic() >= due:
                    due = time.monotonic() + PROGRESS_EVERY
                    progress(f"step {seeds.step:,}/{total:,} of {len(seeds.runs)} runs")
            outcome = stop.reason if seeds.step < total else ""
        except (Exception, SystemExit) as error:
            outcome = f"failed: {error if isinstance(error, CoopError) else first_line(error)}"
            raise
        finally:
            for k, run in enumerate(seeds.runs):
                seeds.save_into(k)
                self._end(run, outcome or run.trainer.outcome())
        return self._summaries, self._failed

    def _block(self) -> None:
        """Play a block of steps, write what it tells, and save what is due."""
        seeds = self._seeds
        for block in seeds.play(MOST):
            directory = self._files[block.run]
            directory.record(block.episodes, None)
            for row in block.metrics:
                directory.record((), row)
            if block.run.trainer.diverged:
                self._end(block.run, block.run.trainer.diverged)
        for k, run in enumerate(seeds.runs):
            if run.trainer.checkpoint_due() and seeds.step < run.config.total_steps:
                run.trainer.checkpoint_begun()
                seeds.save_into(k)
                self._save(run)

    def _save(self, run: Lockstep) -> None:
        try:
            run.save(self._files[run])
        except RunError as error:
            say(f"{error}; the run goes on without it")

    def _end(self, run: Lockstep, outcome: str) -> None:
        """Complete a run's files."""
        trainer, directory = run.trainer, self._files[run]
        if not trainer.diverged and trainer.saveable():
            self._save(run)
        summary = summarise(trainer, trainer.diverged or outcome, time.monotonic(), run.step)
        self._summaries.append(summary)
        try:
            directory.conclude(summary, f"{summary.title}, lockstep")
        except RunError as error:
            self._failed.append(str(error))


def alike(configs: Sequence[RunConfig]) -> bool:
    """Whether runs differ in nothing but their seeds."""
    return len({replace(config, seed=0) for config in configs}) == 1


def main() -> None:
    """Entry point."""
    run_main(PROGRAM, _run)


def _run() -> None:
    parser = argparse.ArgumentParser(
        "python -m coop.studies.stacked.together", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("directories", nargs="+", type=Path)
    parser.add_argument("--player", type=int, choices=(1, 2), help="the network that always acts")
    parser.add_argument("--log", default=DEFAULT_LOG, help="as of coop-lockstep")
    args = parser.parse_args()
    configs = [read_run_config(path) for path in args.directories]
    if not alike(configs):
        raise UsageError("the runs of these directories differ in more than their seeds")
    if reason := why_not(configs[0]):
        raise UsageError(f"side by side: {reason}")
    stop = Stop()
    stop.on_signals()
    failed = []
    with ExitStack() as stack:
        runs = []
        for config, path in zip(configs, args.directories, strict=True):
            try:
                run = LockstepRun(config, path, PROGRAM, Start(resume=True), log=args.log)
            except CoopError as error:
                failed.append(str(error))
                say(f"{path}: {error}")
                continue
            stack.callback(run.close)
            runs.append(run)
        if runs:
            summaries = play_together(runs, stop, None if args.player is None else args.player - 1, say)
            for run, summary in zip(runs, summaries, strict=False):
                say(f"{run.path}: {summary}")
    if failed:
        raise RunError(f"{len(failed)} of {len(configs)} runs can't go on: {failed[0]}")
    if stop.is_set():
        stop.raise_for_status()


if __name__ == "__main__":
    main()
