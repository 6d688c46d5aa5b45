"""The files of a run: config, episodes, metrics, summary, films and the learning curve; and its sinks."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from coop.common.errors import CoopError, RunError
from coop.common.imports import describe, remember
from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.process.console import say
from coop.common.process.files import FileDigest, make_folder, measure, truncate, write_atomic
from coop.common.process.untrusted import MAX_SETTINGS, read_text
from coop.common.settings.config import RunConfig, value_of
from coop.common.settings.overrides import leaves
from coop.common.settings.reading import parse_toml
from coop.common.settings.resuming import settings_digest
from coop.common.settings.tables import CONFIG, run_config_text, to_tables
from coop.common.types import EpisodeRow
from coop.records.checkpoints import RECORDS, SWEEP
from coop.records.curve import draw_learning_curve
from coop.records.resumption import Survey, go_back
from coop.records.run_ids import RUN_ID, claim, has_run_id, read_run_id
from coop.records.sinks import DEFAULT_LOG, ChosenSinks, Kept, RecordedRun, Sink, chosen_sinks
from coop.records.sinks.files import RecordFiles
from coop.records.summaries import SUMMARY, Summary, summary_text


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
        log: str | Sequence[str] = DEFAULT_LOG,
    ) -> None:
        """Create a run's files; or continue them from one of its checkpoints, which seals how long they were then.

        found, number: what the directory holds, and the whole checkpoint to continue; None if the run begins.
        env_step: environment steps at that checkpoint. log: see `chosen_sinks`.

        Raises:
            RunError: a file can't be written.
            UsageError: a sink refuses.
        """
        self.path = path
        self.settings = settings_digest(config)
        self.fallbacks: list[str] = []
        self.aside = ""
        sealed: Mapping[str, FileDigest] = {}
        opened, new = ExitStack(), not has_run_id(path)
        try:
            newest = None if found is None or number is None else found.of(number)
            run_id = claim_run_directory(path, config, None if newest is None else newest.manifest.run)
            goes_on, names = number is not None, chosen_sinks(log)
            if goes_on and (path / "tb").exists():
                names = tuple(dict.fromkeys((*names, DEFAULT_LOG)))  # which has to be cut back as well
            run = RecordedRun(path, run_id, *_study(path.parent, config))
            self._sinks = ChosenSinks(run, names)
            opened.callback(self._sinks.close)
            (path / SUMMARY).unlink(missing_ok=True)  # of the end that this run is no longer at
            if found is not None:
                self.aside = go_back(found, number)
                if newest is not None:
                    self.fallbacks = [*newest.manifest.fallbacks, *found.fallbacks(newest.number)]
                    sealed = newest.manifest.records
            for name, (size, _) in sealed.items():
                truncate(path / name, size)
            kept = None
            if goes_on:
                kept = Kept(_lines(path / RECORDS[0]) - 1, _lines(path / RECORDS[1]), env_step)
            self._files = RecordFiles(run)
            opened.callback(self._files.close)
            for sink in (self._sinks, self._files):
                sink.begin({".".join(place): value for place, value in leaves(to_tables(config))}, kept)
        except BaseException as error:
            opened.close()
            if new:  # no run has begun
                (path / RUN_ID).unlink(missing_ok=True)
            if not isinstance(error, OSError):
                raise
            raise RunError(f"run directory {path}: {error.strerror or error}") from error
        self._problem = ""
        self._eval_return: float | None = None

    def run_id(self) -> int:
        """The random id of this run, which distinguishes it from others of its name; raises RunError."""
        return read_run_id(self.path)

    def record(self, episodes: Iterable[EpisodeRow], metrics: dict[str, Any] | None) -> None:
        """Record episodes, and a row of metrics if there is one."""
        rows = list(episodes)
        if not rows and metrics is None:
            return

        def tell(sink: Sink) -> None:
            for row in rows:
                sink.episode(row)
            if metrics is not None:
                sink.metrics(metrics)

        self._tell(tell)
        self._look()

    @property
    def evaluated(self) -> int:
        """Environment steps at the last evaluation; 0 before it."""
        return self._files.evaluated

    def evaluation(self, row: EvaluationRow) -> None:
        """Record an evaluation."""
        self._eval_return = row.return_mean
        self._tell(lambda sink: sink.evaluation(row))
        self._look()

    def film(self, gif: bytes, env_step: int) -> None:
        """Write a film of the acting network after `env_step` steps to videos/, and tell the sinks."""
        path = self.path / "videos" / f"{env_step}.gif"
        try:
            make_folder(path.parent)
            write_atomic(path, gif)
        except OSError as error:
            say(f"{path}: {error.strerror or error}")
            return
        self._tell(lambda sink: sink.film(gif, env_step))
        self._look()

    def conclude(self, summary: Summary, title: str) -> None:
        """Write the kept lines, then summary.json, and try to draw the learning curve.

        Raises:
            RunError: there is no space for lines or summary; says how the run has ended all the same.
        """
        try:
            self._files.sync()
            sealed = {**self._files.measured, CONFIG: measure(self.path / CONFIG)}
            fields = {**asdict(summary), "fallbacks": self.fallbacks, "records": sealed}
            write_atomic(self.path / SUMMARY, summary_text(fields).encode())
        except OSError as error:
            # The message must also say how the run ended.
            raise RunError(f"{self.path}: {error.strerror or error}; how the run ended: {summary.exit}") from error
        told = {**asdict(summary), "eval_return_mean": self._eval_return}
        self._sinks.tell(lambda sink: sink.conclude(told))
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
        return {name: self._files.measured[name] for name in RECORDS}

    def close(self) -> None:
        """Close all files and sinks."""
        self._files.close()
        self._sinks.close()

    def _tell(self, call: Callable[[Sink], None]) -> None:
        call(self._files)
        self._sinks.tell(call)

    def _look(self) -> None:
        """Report once that the disk is full, and once that it has space again; no line is lost in between."""
        problem = self._files.problem or self._sinks.problem
        if problem != self._problem:
            say(f"{self.path}: {problem or 'can be written again'}")
        self._problem = problem

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _study(folder: Path, config: RunConfig) -> tuple[str, dict[str, Any]]:
    """The name of the sweep that a folder is of, and the values of the settings that it varies, method and seed first.

    Empty if it is none's.
    """
    if not (folder / SWEEP).exists():
        return "", {}
    try:
        varied = parse_toml(read_text(folder / SWEEP, MAX_SETTINGS)).get("vary", {})
        names = [".".join(place) for place, _ in leaves(varied)]
    except (OSError, ValueError, CoopError, AttributeError):  # a sweep's own command names it
        names = []
    cell = {name: value_of(config, name) for name in dict.fromkeys(("method", "seed", *names))}
    return folder.name, {name: value for name, value in cell.items() if value is not None}


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
