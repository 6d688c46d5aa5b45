"""Follows the records of a run as they grow: rows of metrics, episodes and evaluations, and who is called with each."""

from __future__ import annotations

import csv
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from coop.common.errors import CoopError, RunError, UsageError
from coop.common.imports import describe
from coop.common.numbers import RETURN_WINDOW
from coop.common.process.lifecycle import Stop
from coop.records.checkpoints import EVALUATIONS, RECORDS
from coop.records.growing import GrowingFile
from coop.records.reading import parse_row
from coop.records.sinks.files import EPISODE_FIELDS, FIELDS

Row = dict[str, Any]
Callback = Callable[[Row], object]
EPISODES, METRICS = RECORDS
_KEYS = {EPISODES: "episode", METRICS: "update", EVALUATIONS: "env_step"}  # each grows from row to row
_FIELDS = {EPISODES: EPISODE_FIELDS, EVALUATIONS: FIELDS}


class Following:
    """A record that is being written; each row is given once, even if the run has gone back to a checkpoint."""

    def __init__(self, run_dir: Path, name: str) -> None:
        """name: one of episodes.csv, metrics.jsonl and evaluations.csv, which need not exist yet."""
        self._file, self._name = GrowingFile(run_dir / name), name
        self._newest = -1

    def rows(self) -> list[Row]:
        """The rows since the last call, numbers as such; raises RunError for a line that can't be read."""
        try:
            lines = self._file.raw_lines()
        except FileNotFoundError:
            return []
        if self._name != METRICS and self._file.from_start:
            lines = lines[1:]  # the header
        found = []
        for row in map(self._parse, lines):
            if row[_KEYS[self._name]] > self._newest:  # else the run has gone back to a checkpoint
                self._newest = row[_KEYS[self._name]]
                found.append(row)
        return found

    def _parse(self, line: bytes) -> Row:
        place = f"{self._file.path}, after {_KEYS[self._name]} {max(self._newest, 0):,}"
        if self._name == METRICS:
            return parse_row(line, place)
        try:
            (values,) = csv.reader([line.decode()])
            return {name: _value(name, text) for name, text in zip(_FIELDS[self._name], values, strict=True)}
        except (ValueError, csv.Error) as error:
            raise RunError(f"{place}: {error}") from error


def _value(name: str, text: str) -> int | float | str:
    """The value of a field; `actor` is a name."""
    if name == "actor":
        return text
    return int(text) if text.lstrip("-").isdecimal() else float(text)


class MetricsFollowing:
    """As `Following` of metrics.jsonl, with what episodes and evaluations had reached before each row."""

    def __init__(self, run_dir: Path) -> None:
        self._metrics, self._episodes = Following(run_dir, METRICS), Following(run_dir, EPISODES)
        self._evaluations = Following(run_dir, EVALUATIONS)
        self._ended: deque[Row] = deque()  # later than the newest row
        self._evaluated: deque[Row] = deque()
        self._returns: deque[float] = deque(maxlen=RETURN_WINDOW)
        self._newest: Row = {}

    def rows(self) -> list[Row]:
        """The rows since the last call, with `return_mean_100`, `eval_return_mean` and `eval_env_step`.

        These are the mean return of the last 100 episodes and the newest evaluation before the row, or None.

        Raises:
            RunError: a line can't be read.
        """
        rows = self._metrics.rows()
        self._ended += self._episodes.rows()
        self._evaluated += self._evaluations.rows()
        return [{**row, **self._before(row["env_step"])} for row in rows]

    def _before(self, env_step: int) -> Row:
        # Those of the same step are written after the row.
        while self._ended and self._ended[0]["env_step"] < env_step:
            self._returns.append(self._ended.popleft()["return"])
        while self._evaluated and self._evaluated[0]["env_step"] < env_step:
            self._newest = self._evaluated.popleft()
        return {
            "return_mean_100": sum(self._returns) / len(self._returns) if self._returns else None,
            "eval_return_mean": self._newest.get("return_mean"),
            "eval_env_step": self._newest.get("env_step"),
        }


class Callbacks:
    """Functions that are called with each new row of a run's records, and may stop the run by what they return."""

    def __init__(self, given: Mapping[str, Callback | None] = MappingProxyType({})) -> None:
        """given: by name, "on_metrics", "on_episode", "on_evaluation"; raises UsageError for what can't be called."""
        self._given = {name: callback for name, callback in given.items() if callback is not None}
        for name, callback in self._given.items():
            if not callable(callback):
                raise UsageError(f"{name} = {callback!r}: must be a function of a row")
        self._followed: dict[str, Following | MetricsFollowing] = {}
        self._failure: RunError | None = None

    def __bool__(self) -> bool:
        return bool(self._given)

    def follow(self, run_dir: Path, stop: Stop) -> None:
        """Follow a run, and stop it as they want; rows that are there already are passed over. Raises RunError."""
        self._stop = stop
        followed: dict[str, Following | MetricsFollowing] = {
            "on_episode": Following(run_dir, EPISODES),
            "on_evaluation": Following(run_dir, EVALUATIONS),
            "on_metrics": MetricsFollowing(run_dir),
        }
        self._followed = {name: followed[name] for name in followed if name in self._given}
        for each in self._followed.values():
            each.rows()

    def look(self) -> None:
        """Call them with the rows since the last call. One that fails stops the run, and no other is called then."""
        try:
            for name, following in self._followed.items():
                for row in following.rows():
                    if self._call(name, row):
                        self._stop.set(f"stopped by {name}")
        except RunError as failure:
            self._failure, self._followed = failure, {}
            self._stop.set(f"failed: {failure}")

    def _call(self, name: str, row: Row) -> bool:
        try:
            return bool(self._given[name](row))
        except BaseException as error:  # users' code may raise anything
            raise RunError(f"{name}: {str(error) if isinstance(error, CoopError) else describe(error)}") from error

    def finish(self) -> None:
        """Call them with the rest, after the end of the run; raises RunError if one has failed."""
        self.look()
        if self._failure is not None:
            raise self._failure
