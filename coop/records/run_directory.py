"""The files of a run: config, episodes, metrics, TensorBoard, summary and the learning curve."""

from __future__ import annotations

import csv
import secrets
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from coop.common.errors import RunError
from coop.common.imports import describe, remember
from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.numbers import exact, strict_json
from coop.common.process.console import say
from coop.common.process.files import FileDigest, LineFile, make_folder, measure, truncate, write_atomic
from coop.common.settings.config import RunConfig
from coop.common.settings.overrides import leaves
from coop.common.settings.resuming import settings_digest
from coop.common.settings.tables import CONFIG, run_config_text, to_tables
from coop.common.types import EpisodeRow
from coop.records.checkpoints import RECORDS
from coop.records.curve import draw_learning_curve
from coop.records.evaluations import EVALUATIONS, EvaluationsFile
from coop.records.resumption import Survey, go_back
from coop.records.run_ids import claim, has_run_id, read_run_id
from coop.records.summaries import SUMMARY, Summary, summary_text
from coop.records.tensorboard import Kept, TensorBoardWriter
from coop.records.wandb_mirror import WandbMirror

EPISODE_FIELDS = (
    "episode", "env_step", "update", "actor", "stream", "return", "length",
    "epsilon", "s", "q1_mean", "q2_mean", "param_version",
)  # fmt: skip


class RunDirectory:
    """Writes a run's files during the run; when a call returns, its lines are complete if the disk has space."""

    def __init__(
        self,
        path: Path,
        config: RunConfig,
        found: Survey | None = None,
        number: int | None = None,
        env_step: int = 0,
        *,
        wandb: bool = False,
    ) -> None:
        """Create a run's files; or continue them from one of its checkpoints, which seals how long they were then.

        found, number: what the directory holds, and the whole checkpoint to continue; None if the run begins.
        env_step: environment steps at that checkpoint. wandb: mirror TensorBoard's scalars to Weights & Biases.

        Raises:
            RunError: a file can't be written.
            UsageError: Weights & Biases refuses.
        """
        self.path = path
        self.settings = settings_digest(config)
        self.fallbacks: list[str] = []
        self.aside = ""
        sealed: Mapping[str, FileDigest] = {}
        try:
            (path / SUMMARY).unlink(missing_ok=True)  # of the end that this run is no longer at
            newest = None if found is None or number is None else found.of(number)
            run_id = claim_run_directory(path, config, None if newest is None else newest.manifest.run)
            mirror = WandbMirror(path, run_id) if wandb else None
            if found is not None:
                self.aside = go_back(found, number)
                if newest is not None:
                    self.fallbacks = [*newest.manifest.fallbacks, *found.fallbacks(newest.number)]
                    sealed = newest.manifest.records
            for name, (size, _) in sealed.items():
                truncate(path / name, size)
            goes_on = number is not None
            self._episodes, self._metrics = (LineFile(path / name, go_on=goes_on) for name in RECORDS)
            self._evaluations = EvaluationsFile(path, env_step if goes_on else None)
            kept = None
            if goes_on:
                kept = Kept(_lines(path / RECORDS[0]) - 1, _lines(path / RECORDS[1]), env_step)
            self._tensorboard = TensorBoardWriter(path / "tb", mirror, kept)
            self._tensorboard.hyperparameters({".".join(place): value for place, value in leaves(to_tables(config))})
        except OSError as error:
            raise RunError(f"run directory {path}: {error.strerror or error}") from error
        self._csv = csv.writer(self._episodes, lineterminator="\n")
        if not goes_on:
            self._csv.writerow(EPISODE_FIELDS)
        self._problem = ""

    def run_id(self) -> int:
        """The random id of this run, which distinguishes it from others of its name; raises RunError."""
        return read_run_id(self.path)

    def record(self, episodes: Iterable[EpisodeRow], metrics: dict[str, Any] | None) -> None:
        """Write lines to episodes.csv, and a row, if there is one, to metrics.jsonl."""
        for episode in episodes:
            self._episode(episode)
        if metrics is not None:
            self._metrics_row(metrics)
        self._look()

    def _episode(self, row: EpisodeRow) -> None:
        record, end = row.record, row.record.end
        place = (row.number, record.env_step, row.update, f"{record.actor:x}", record.stream)
        values = (f"{value:.6g}" for value in (end.epsilon, row.s, end.q1_mean, end.q2_mean))
        self._csv.writerow((*place, exact(end.episode_return), end.length, *values, end.param_version))
        self._tensorboard.episode(end.episode_return, end.length, record.env_step)

    def _metrics_row(self, row: dict[str, Any]) -> None:
        """Add a line to metrics.jsonl, and its numbers to TensorBoard."""
        self._metrics.write(strict_json({"time": time.time(), **row}) + "\n")
        self._tensorboard.metrics(row)

    @property
    def evaluated(self) -> int:
        """Environment steps at the last evaluation; 0 before it."""
        return self._evaluations.newest

    def evaluation(self, row: EvaluationRow) -> None:
        """Add a line to evaluations.csv, and its returns to TensorBoard."""
        self._evaluations.add(row)
        self._tensorboard.evaluation(row.return_mean, row.return_sd, row.env_step)
        self._look()

    def video(self, gif: bytes, env_step: int) -> None:
        """Write a film of the acting network after `env_step` steps to videos/, and to TensorBoard."""
        path = self.path / "videos" / f"{env_step}.gif"
        try:
            make_folder(path.parent)
            write_atomic(path, gif)
        except OSError as error:
            say(f"{path}: {error.strerror or error}")
            return
        self._tensorboard.video(gif, env_step)
        self._look()

    def conclude(self, summary: Summary, title: str) -> None:
        """Write the kept lines, then summary.json, and try to draw the learning curve.

        Raises:
            RunError: there is no space for lines or summary; says how the run has ended all the same.
        """
        try:
            files = (self._episodes, self._metrics, self._evaluations)
            for file in files:
                file.sync()
            sealed = {name: file.measured for name, file in zip((*RECORDS, EVALUATIONS), files, strict=True)}
            sealed[CONFIG] = measure(self.path / CONFIG)
            fields = {**asdict(summary), "fallbacks": self.fallbacks, "records": sealed}
            write_atomic(self.path / SUMMARY, summary_text(fields).encode())
        except OSError as error:
            # The message must also say how the run ended.
            raise RunError(f"{self.path}: {error.strerror or error}; how the run ended: {summary.exit}") from error
        self.draw(title)

    def draw(self, title: str) -> None:
        """Draw the learning curve; a run whose curve can't be drawn is as complete."""
        try:
            draw_learning_curve(self.path, title)
        except OSError as error:
            say(f"{self.path}: no learning curve: {error.strerror or error}")
        except Exception as error:  # matplotlib's own settings, and the fonts and programs that they name
            say(f"{self.path}: no learning curve: {describe(error)[:200]}")

    def records(self) -> dict[str, FileDigest]:
        """What the growing files hold now, for a checkpoint."""
        return {name: file.measured for name, file in zip(RECORDS, (self._episodes, self._metrics), strict=True)}

    def close(self) -> None:
        """Close all files."""
        self._episodes.close()
        self._metrics.close()
        self._evaluations.close()
        self._tensorboard.close()

    def _look(self) -> None:
        """Report once that the disk is full, and once that it has space again; no line is lost in between."""
        files = (self._episodes, self._metrics, self._evaluations, self._tensorboard)
        problem = next((file.problem for file in files if file.problem), "")
        if problem != self._problem:
            say(f"{self.path}: {problem or 'can be written again'}")
        self._problem = problem

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _lines(path: Path) -> int:
    with path.open("rb") as file:
        return sum(1 for _ in file)


def claim_run_directory(path: Path, config: RunConfig, known: int | None = None) -> int:
    """Assign a directory to this run, or check that it is assigned; write its config and return the run's id.

    known: the id, if a checkpoint there names it.

    Raises:
        RunError: it cannot be written.
    """
    try:
        make_folder(path)
        drawn = secrets.randbits(63) if known is None else known
        run_id = read_run_id(path) if has_run_id(path) else drawn
        # First, as an id alone makes it a replay service's folder.
        write_atomic(path / CONFIG, run_config_text(config).encode())
    except OSError as error:
        raise RunError(f"run directory {path}: {error.strerror or error}") from error
    claim(path, run_id)
    remember(path)
    return run_id
