"""Differences of a study's runs from a chosen baseline, over the same seeds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pandas as pd

from coop.common.errors import UsageError, closest, refusal
from coop.studies.report.comparisons import MEASURES
from coop.studies.report.intervals import Estimate, over_seeds
from coop.studies.report.learning import by_seed, differences
from coop.studies.report.plots import Figure, Panel
from coop.studies.report.slices import counts, label
from coop.studies.report.study import Study
from coop.studies.report.summaries import MOST_TICKS, dodge, tick_lines
from coop.studies.report.table import ResultTable, Value

ALL = "all"  # in place of a setting: the mean over the settings that a method shares with the baseline


@dataclass(frozen=True)
class Baseline:
    """A method, which others are compared with at each setting; or the runs of one method at one setting.

    setting: index in the study's settings; None for a method everywhere.
    """

    name: str
    method: str
    setting: int | None


@dataclass(frozen=True)
class Difference:
    """Runs minus the baseline's, by one measure: means over the seeds that both have.

    place: index of the setting; None for the mean over the shared ones.
    """

    measure: str
    method: str
    place: int | None
    own: float
    other: float
    estimate: Estimate
    seeds: int


def find_baseline(study: Study, name: str) -> Baseline:
    """The method of this name, or the method and setting of the run of this name; raises UsageError.

    A run's name may lack its seed: all seeds of its setting are the baseline anyway.
    """
    if name in study.methods:
        return Baseline(name, name, None)
    named = {run.name: run for run in study.runs} | {run.name.rpartition("-seed=")[0]: run for run in study.runs}
    if not name or name not in named:
        hint = f"allowed: {', '.join(study.methods)}, or the name of a run's folder"
        raise UsageError(f"--baseline {name}: {refusal('unknown', closest(name, [*study.methods, *named]), hint)}")
    run = named[name]
    words = ", ".join(filter(None, (run.config.method, label(study, study.setting(run)))))
    return Baseline(words, run.config.method, study.settings.index(study.setting(run)))


def differences_from(study: Study, baseline: Baseline) -> list[Difference]:
    """All differences from a baseline; raises UsageError if there is nothing to compare it with."""
    found: list[Difference] = []
    for name, measure in MEASURES.items():
        values = by_seed(study, measure)
        for method in study.methods:
            found += _of_method(baseline, name, method, values)
    if not found:
        raise UsageError(f"--baseline {baseline.name}: no other runs have seeds in common with it")
    return found


def _of_method(baseline: Baseline, measure: str, method: str, values: pd.DataFrame) -> Iterator[Difference]:
    if baseline.setting is not None:
        other = values[baseline.method][baseline.setting]
        for place, own in values[method].items():
            seeds = own.dropna().index.intersection(other.dropna().index)
            if len(seeds) and (method, place) != (baseline.method, baseline.setting):
                yield _difference(measure, method, place, own[seeds], other[seeds])
    elif method != baseline.method:
        apart = differences(values, method, baseline.method)
        own, other = (values[name].loc[apart.index, apart.columns] for name in (method, baseline.method))
        for place in apart.columns if len(apart) else []:
            yield _difference(measure, method, place, own[place], other[place])
        if len(apart) and len(apart.columns) > 1:
            yield _difference(measure, method, None, own.mean(axis="columns"), other.mean(axis="columns"))


def _difference(measure: str, method: str, place: int | None, own: pd.Series, other: pd.Series) -> Difference:
    estimate = over_seeds((own - other).to_numpy())
    return Difference(measure, method, place, float(own.mean()), float(other.mean()), estimate, len(own))


def baseline_table(study: Study, baseline: Baseline) -> ResultTable:
    """The differences as a table."""
    rows: list[list[Value]] = [
        [each.measure, each.method, _where(study, each), each.own, each.other, *each.estimate, each.seeds]
        for each in differences_from(study, baseline)
    ]
    columns = ["measure", "method", "setting", "mean", "baseline", "difference", "low", "high", "seeds"]
    note = (
        f"Each method's mean minus that of {baseline.name}, over the seeds that both have, with 95 % t "
        "intervals over seeds (none for one seed). area: mean over steps of the running mean of 100 episodes."
    )
    spreads = {"difference": ["low", "high"]}
    return ResultTable("baseline", f"Differences from {baseline.name}", columns, rows, note, spreads)


def baseline_figure(study: Study, baseline: Baseline) -> Figure:
    """The differences as a figure: a panel for each measure; over all settings only, if there are too many."""
    found = differences_from(study, baseline)
    if len({each.place for each in found}) > MOST_TICKS:
        found = [each for each in found if each.place is None]
    places = sorted({each.place for each in found}, key=lambda place: len(study.settings) if place is None else place)
    alone = len(places) == 1
    methods = list(dict.fromkeys(each.method for each in found))
    ticks = methods if alone else [ALL if each is None else label(study, study.settings[each]) for each in places]
    panels = []
    for measure in MEASURES:
        points: dict[str, dict[int, tuple[float, float, float]]] = {}
        for each in found:
            if each.measure == measure:
                tick = methods.index(each.method) if alone else places.index(each.place)
                points.setdefault(each.method, {})[tick] = each.estimate
        lines = tick_lines(points, {} if alone else dodge(methods))
        panels.append(Panel("", "", f"difference of {measure}", lines, True, ticks=ticks, reference=0.0))
    text = f"Mean minus that of {baseline.name} over the seeds that both have; 95 % t interval over seeds."
    return Figure("baseline", f"Differences from {baseline.name}", text, counts(study.runs), panels)


def _where(study: Study, difference: Difference) -> str:
    return ALL if difference.place is None else label(study, study.settings[difference.place]) or ALL
