"""The finished runs of a folder, and the fields in which their configs differ."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from coop.common.errors import RunError, UsageError
from coop.common.numbers import METRICS_EVERY
from coop.common.settings.config import OF_MACHINE, RunConfig, value_of
from coop.common.settings.methods import METHODS
from coop.common.settings.tables import identity, load_tables, parse_run_config, resolve
from coop.records.checkpoints import EVALUATIONS
from coop.records.reading import returns_by_step
from coop.records.summaries import parse_summary
from coop.studies.report.packed import CONFIG, EPISODES, METRICS, SUMMARY, SWEEP
from coop.studies.report.sources import RunSource, open_source
from coop.studies.sweep.grid import Grid, parse_grid, starting

Floats = NDArray[np.float64]
Setting = tuple[Any, ...]  # a value for each axis

Groups = Mapping[tuple[str, int], list["Run"]]  # runs by method and index of the setting

SERIES = ("env_step", "q_gap", "sample_age_mean", "sample_age_p95", "reuse_mean", "evicted_unsampled")
# Missing in runs of earlier versions.
LATER = ("archive_td_error", "archive_drift", "policy_churn", "dormant_share", "effective_rank", "terminal_share")
Q_SIZE, Q_BOUND, Q_SHARE = "q_abs_mean", "q_bound", "q_share"
CHURN = "churn_per_100"
NOT_AXES = {"run", "method", "seed"}
PRESET = "cartpole"
SHOWN = 3  # unfinished runs in an error


@dataclass(frozen=True)
class Run:
    """One finished run with at least one episode.

    end_steps: float64 [episodes], environment steps when each episode ended. returns, s, q1_means, q2_means: float64
    [episodes], of the columns `return`, `s`, `q1_mean` and `q2_mean`. metrics: float64 [rows] of each name of SERIES,
    of LATER, of "q_share", mean |Q| as a share of its bound, and of "churn_per_100", the share of greedy actions that
    100 updates of a network change; nan where a row lacks it.
    above_bound: number of rows of metrics.jsonl whose mean |Q| exceeds its bound, `q_bound`. evaluated: float64
    [2, evaluations], environment steps and mean returns of greedy play. fallbacks: where it went on from an older
    checkpoint than its newest, which was not whole.
    """

    name: str
    config: RunConfig
    end_steps: Floats
    returns: Floats
    s: Floats
    q1_means: Floats
    q2_means: Floats
    metrics: Mapping[str, Floats]
    above_bound: int = 0
    fallbacks: Sequence[str] = ()
    evaluated: Floats = field(default_factory=lambda: np.empty((2, 0)))


@dataclass(frozen=True)
class Study:
    """The runs of one folder.

    axes: dotted names of the fields that differ between runs of one method.
    missing: names of runs that are expected or begun but not finished, each with its state.
    diverged: names and configs of runs that diverged; they are counted, but included in no mean.
    reference: for each axis, the value nearest to the preset's.
    """

    title: str
    runs: tuple[Run, ...]
    missing: Mapping[str, str]
    diverged: Mapping[str, RunConfig]
    axes: tuple[str, ...]
    reference: Setting

    @property
    def methods(self) -> list[str]:
        """The methods with a finished run: those of the registry, of the paper's table first, then users' own."""
        found = dict.fromkeys(run.config.method for run in self.runs)
        known = [method for method in METHODS.names() if method in found]
        return [*known, *(method for method in found if method not in known)]

    @property
    def buffered(self) -> list[str]:
        """The methods with a finished run that have a replay buffer."""
        return [method for method in self.methods if METHODS.get(method).stream is None]

    @property
    def eviction(self) -> str:
        """By which policies the buffers of the runs evict, as a sentence; empty if no run has a buffer."""
        found = sorted({run.config.replay.eviction for run in self.runs if not run.config.streaming})
        return f"Eviction: {', '.join(found)}." if found else ""

    @property
    def environments(self) -> list[str]:
        """The environments of the runs."""
        return sorted({run.config.env.id for run in self.runs})

    @property
    def one_scale(self) -> bool:
        """Whether all returns have one scale: those of one environment do."""
        return len(self.environments) == 1

    @property
    def warnings(self) -> list[str]:
        """A line for each finished run whose mean |Q| exceeded its bound at times, and for each fallback of a run."""
        fallen = [f"{run.name}: went on from an older checkpoint: {why}" for run in self.runs for why in run.fallbacks]
        return fallen + [
            f"{run.name}: mean |Q| is above the largest that the rewards seen allow in {run.above_bound} of "
            f"{len(run.metrics['env_step'])} rows of {METRICS}"
            for run in self.runs
            if run.above_bound
        ]

    def setting(self, run: Run) -> Setting:
        """The run's value on each axis."""
        return self.setting_of(run.config)

    def setting_of(self, config: RunConfig) -> Setting:
        """A config's value on each axis."""
        return tuple(value_of(config, axis) for axis in self.axes)

    @cached_property
    def settings(self) -> list[Setting]:
        """All settings of runs, in order."""
        return sorted(set(map(self.setting, self.runs)), key=lambda setting: [_order(value) for value in setting])

    @cached_property
    def frame(self) -> pd.DataFrame:
        """A row per run, ordered by seed: `run`, `method`, `seed` and `setting`, the index in `settings`."""
        return self._frame(lambda run: [self.setting(run)])

    @cached_property
    def comparable(self) -> pd.DataFrame:
        """Like `frame`, but a run without a replay buffer has a row at each setting of the others' buffers."""
        return self._frame(self._compared_settings)

    def _frame(self, settings_of: Callable[[Run], Sequence[Setting]]) -> pd.DataFrame:
        places = {setting: place for place, setting in enumerate(self.settings)}
        rows = [(run, run.config.method, run.config.seed, places[at]) for run in self.runs for at in settings_of(run)]
        return pd.DataFrame(rows, columns=["run", "method", "seed", "setting"]).sort_values("seed", kind="stable")

    def _compared_settings(self, run: Run) -> list[Setting]:
        """The settings at which a run is compared with others."""
        own = self.setting(run)
        if not run.config.streaming:
            return [own]
        fixed = [place for place, axis in enumerate(self.axes) if not axis.startswith("replay.")]
        return [setting for setting in self.settings if all(setting[place] == own[place] for place in fixed)]

    def of(self, method: str, setting: Setting) -> list[Run]:
        """The runs of one method at one setting, ordered by seed."""
        return self._find(self._groups, method, setting)

    def compared(self, method: str, setting: Setting) -> list[Run]:
        """The runs with which others at a setting are compared: as `of`, or those without a replay buffer."""
        return self._find(self._comparable_groups, method, setting)

    def _find(self, groups: Groups, method: str, setting: Setting) -> list[Run]:
        return groups.get((method, self.settings.index(setting)), []) if setting in self.settings else []

    @cached_property
    def _groups(self) -> Groups:
        return _grouped(self.frame)

    @cached_property
    def _comparable_groups(self) -> Groups:
        return _grouped(self.comparable)

    def index(self, axis: str) -> int | None:
        """The index of an axis in a setting; None if the runs do not differ in it."""
        return self.axes.index(axis) if axis in self.axes else None


def _grouped(frame: pd.DataFrame) -> Groups:
    return {key: list(runs) for key, runs in frame.groupby(["method", "setting"])["run"]}


def load_study(path: Path) -> Study:
    """Read a sweep's folder, any folder of run directories, or a packed study.

    Raises:
        UsageError: it holds no run.
        RunError: no run in it is finished, or a file is torn.
    """
    source = open_source(path)
    grid, names = runs_of(source, path)
    if not names:
        raise UsageError(f"{path}: holds no run and no {SWEEP}")
    runs, missing, diverged = [], {}, {}
    for name in names:
        state = _state(source, name)
        run = None if state else _read(source, name, path)
        if state.startswith("diverged"):
            diverged[name] = read_config(source, name, path)
            missing[name] = state
        elif run is None:
            missing[name] = state
        elif not len(run.returns):
            missing[name] = "finished without a finished episode"
        else:
            runs.append(run)
    if not runs:
        also = f", {len(diverged)} diverged" if diverged else ""
        states = ", ".join(f"{name}: {state}" for name, state in list(missing.items())[:SHOWN])
        more = f" (and {len(missing) - SHOWN} more)" if len(missing) > SHOWN else ""
        raise RunError(f"{path}: none of its {len(names)} runs is finished{also}: {states}{more}")
    axes = _axes([*(run.config for run in runs), *diverged.values()])
    preset = resolve(starting(grid.file) if grid else load_tables(PRESET, None))
    reference = tuple(_nearest(value_of(preset, axis), {value_of(run.config, axis) for run in runs}) for axis in axes)
    return Study(grid.file.title if grid else "", tuple(runs), missing, diverged, axes, reference)


def runs_of(source: RunSource, path: Path) -> tuple[Grid | None, list[str]]:
    """The grid of a sweep, if it is one, and the names of its runs: a sweep's cells, whatever else is in its folder."""
    if source.sweep is None:
        return None, source.names
    grid = parse_grid(source.sweep, f"{path}/{SWEEP}", check=False)
    return grid, [choice.name for choice in grid.choices]


def _state(source: RunSource, run: str) -> str:
    """Which part of a run is missing; empty if it is finished."""
    summary = source.text(run, SUMMARY)
    if summary is None:
        begun = any(source.text(run, file) is not None for file in (CONFIG, EPISODES))
        return "begun, not finished" if begun else "not begun"
    outcome = str(parse_summary(summary, f"{run}/{SUMMARY}").get("exit", ""))
    if outcome.startswith("diverged"):
        return outcome
    return "" if outcome.startswith("complete") else f"begun, not finished: {outcome}"


def _read(source: RunSource, run: str, path: Path) -> Run:
    config = read_config(source, run, path)
    try:
        episodes = source.columns(run, EPISODES, ("env_step", "return", "s", "q1_mean", "q2_mean"))
        rows = source.columns(run, METRICS, SERIES, (*LATER, Q_SIZE, Q_BOUND))
        ends, returns, s, q1, q2 = (np.array(values, np.float64) for values in episodes.values())
        metrics = {name: np.array(values, np.float64) for name, values in rows.items()}  # None becomes nan
        evaluated = returns_by_step(source.text(run, EVALUATIONS) or "")
    except FileNotFoundError as error:
        raise RunError(f"{path / run}: a finished run without its {Path(error.filename).name}") from error
    except (OSError, ValueError, KeyError, UsageError) as error:
        raise RunError(f"{path / run}: a finished run with a file that can't be read: {error!r}") from error
    size, bound = metrics.pop(Q_SIZE), metrics.pop(Q_BOUND)
    with np.errstate(divide="ignore", invalid="ignore"):  # without rewards the bound is 0
        metrics[Q_SHARE] = size / bound
    metrics[CHURN] = metrics["policy_churn"] * 100 / (METRICS_EVERY / (2 if config.two_networks else 1))
    fallbacks = parse_summary(source.text(run, SUMMARY) or "{}", path / run / SUMMARY).get("fallbacks", [])
    return Run(run, config, ends, returns, s, q1, q2, metrics, int((size > bound).sum()), fallbacks, evaluated)


def read_config(source: RunSource, run: str, path: Path) -> RunConfig:
    """The config of a run of the study at `path`; raises RunError."""
    try:
        return parse_run_config(source.text(run, CONFIG) or "", path / run / CONFIG)
    except UsageError as error:
        raise RunError(str(error)) from error


def _axes(configs: list[RunConfig]) -> tuple[str, ...]:
    """Fields that differ within a method; those that differ only between methods belong to the method."""
    values: dict[tuple[str, str], set[Any]] = {}
    for config in configs:
        machine = {f"learner.{name}": getattr(config.learner, name) for name in OF_MACHINE}
        for name, value in (*_flat(identity(config)), *machine.items()):
            values.setdefault((config.method, name), set()).add(value)
    names = dict.fromkeys(name for (_, name), found in values.items() if len(found) > 1)
    return tuple(name for name in names if name not in NOT_AXES)


def _flat(tables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tables.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _order(value: Any) -> tuple[int, float, str]:  # noqa: ANN401
    """Sort key: numbers by size, other values by their text."""
    return (0, float(value), "") if isinstance(value, int | float) else (1, 0.0, str(value))


def _nearest(wanted: Any, values: set[Any]) -> Any:  # noqa: ANN401
    if wanted in values:
        return wanted
    if isinstance(wanted, int | float):
        return min(sorted(values), key=lambda value: abs(value - wanted))
    return min(values, key=_order)
