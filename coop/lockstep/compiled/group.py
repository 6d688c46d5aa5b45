"""Lockstep runs that are equally far, in compiled loops, each with its own files as `coop-lockstep` leaves them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby

from coop.common.errors import CoopError, RunError, first_line
from coop.common.process.lifecycle import Stop
from coop.learner.summary import summarise
from coop.lockstep.compiled.seeds import MOST, Seeds
from coop.lockstep.lockstep import LOOK_EVERY, PROGRESS_EVERY, Lockstep
from coop.lockstep.memory import TableMemory
from coop.records.checkpoints import take_request
from coop.records.run_directory import RunDirectory
from coop.records.summaries import Summary


def play_runs(
    files: Mapping[Lockstep, RunDirectory],
    stop: Stop,
    progress: Callable[[str], None] = lambda line: None,
    player: int | None = None,
) -> list[Summary]:
    """Play runs that differ in their seeds until each is over, or until the stop, and complete their files.

    Runs that are not equally far go on in groups, one after the other. player: see `Seeds`. progress: called with a
    line every few seconds.

    Raises:
        RunError: the files of some runs can't be completed; the others are.
    """
    for run, directory in files.items():
        _align(run, directory)
    summaries, failed = [], []
    place = {run: (run.step, run.trainer.outcome()) for run in files}
    for _, group in groupby(sorted(files, key=place.__getitem__), key=place.__getitem__):
        played = Group(list(group), files, player)
        played.play(stop, progress)
        summaries += played.summaries
        failed += played.failed
    if failed:
        raise RunError("; ".join(failed))
    return summaries


def _align(run: Lockstep, directory: RunDirectory) -> None:
    """Play to the end of a segment at which every transition is complete: a stop may have come before it."""
    while isinstance(run.memory, TableMemory) and run.memory.waiting and not run.trainer.outcome():
        for effects in run.play():
            directory.record(effects.episodes, effects.metrics)


class Group:
    """Runs that are equally far, at the end of a segment, or that are over.

    summaries: of the runs that are over. failed: what could not be completed.
    """

    def __init__(
        self, runs: Sequence[Lockstep], files: Mapping[Lockstep, RunDirectory], player: int | None = None
    ) -> None:
        self._files, self._config = files, runs[0].config
        # Networks of pictures fill a processor's cache: each run plays a block before the next one.
        parts = [runs] if self._config.network.kind == "mlp" else [[run] for run in runs]
        self._parts = [Seeds(part, player) for part in parts]
        self._looked = 0.0
        self.summaries: list[Summary] = []
        self.failed: list[str] = []

    @property
    def step(self) -> int:
        """Environment steps done, of each."""
        return max(seeds.step for seeds in self._parts)

    def _running(self) -> list[tuple[Seeds, int, Lockstep]]:
        """The runs that go on, each with its place."""
        return [(seeds, k, run) for seeds in self._parts for k, run in enumerate(seeds.runs)]

    def play(self, stop: Stop, progress: Callable[[str], None]) -> None:
        """Play to the end."""
        due, total = time.monotonic() + PROGRESS_EVERY, self._config.total_steps
        over = any(run.trainer.outcome() for *_, run in self._running())
        try:
            while self._running() and not over and self.step < total and not stop.is_set():
                self.block()
                if self._running() and time.monotonic() >= due:
                    due = time.monotonic() + PROGRESS_EVERY
                    progress(self._progress())
        except BaseException as error:  # what a block has not told yet is in no file: the newest checkpoint stays
            outcome = "interrupted"
            if isinstance(error, Exception | SystemExit):
                outcome = f"failed: {error if isinstance(error, CoopError) else first_line(error)}"
            for _, _, run in self._running():
                self._conclude(run, outcome)
            raise
        for seeds, k, run in self._running():
            seeds.save_into(k)
            self._end(run, run.trainer.outcome() or stop.reason)

    def _progress(self) -> str:
        running = self._running()
        if len(running) == 1:
            seeds, k, run = running[0]
            seeds.save_counters(k)
            return run.progress()
        return f"step {self.step:,}/{self._config.total_steps:,} of {len(running)} runs"

    def block(self) -> None:
        """Play a block of steps, write what it tells, and save what is due."""
        for seeds in self._parts:
            for block in seeds.play(MOST) if seeds.runs else ():
                directory = self._files[block.run]
                directory.record(block.episodes, None)
                for row in block.metrics:
                    directory.record((), row)
                if block.outcome:
                    self._end(block.run, block.outcome)
        look = time.monotonic() >= self._looked
        if look:
            self._looked = time.monotonic() + LOOK_EVERY
        for seeds, k, run in self._running():
            if look and take_request(self._files[run].path):
                run.trainer.ask_checkpoint()
            if run.trainer.checkpoint_due() and seeds.step < run.config.total_steps:
                seeds.save_into(k)
                run.save_on_the_way(self._files[run])

    def _end(self, run: Lockstep, outcome: str) -> None:
        """Save a run for good, and complete its files."""
        if run.trainer.saveable():
            try:
                run.save(self._files[run])
            except RunError as error:
                outcome = f"failed: {error}"
                self.failed.append(str(error))
        self._conclude(run, run.trainer.diverged or outcome)

    def _conclude(self, run: Lockstep, outcome: str) -> None:
        summary = summarise(run.trainer, outcome, time.monotonic(), run.step)
        self.summaries.append(summary)
        try:
            self._files[run].conclude(summary, f"{summary.title}, lockstep")
        except RunError as error:
            self.failed.append(str(error))
