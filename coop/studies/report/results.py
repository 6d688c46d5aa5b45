"""The report's tables of a study's results."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from coop.studies.report.comparisons import comparison_tables
from coop.studies.report.intervals import improvement, iqm_of, iqm_overall
from coop.studies.report.measures import breaking_point, diagnostic, diagnostics_of, score, shorter_runs, spread
from coop.studies.report.slices import CAPACITY, along, label, matrices, other_settings, pairs, seeds_of
from coop.studies.report.study import Floats, Run, Setting, Study
from coop.studies.report.table import ResultTable, Value, plain

TABLE_1: dict[str, dict[str, tuple[float, float]]] = {
    "cartpole": {"dqn": (193.6, 0.71), "edql": (199.6, 0.82), "g-coop": (200.0, 0.82), "coop": (200.0, 0.2123)},
    "breakout": {"dqn": (287.0, 78.0), "edql": (290.0, 55.0), "g-coop": (314.0, 15.0), "coop": (313.0, 25.0)},
    "spaceinvaders": {"dqn": (1139, 158), "edql": (980, 163), "g-coop": (1174, 163), "coop": (1144, 121)},
    "pong": {"dqn": (18.9, 2.12), "edql": (19.11, 1.88), "g-coop": (18.91, 1.32), "coop": (19.15, 2.1)},
}  # fmt: skip


def table_1(env_id: str) -> dict[str, tuple[float, float]]:
    """The column of an environment, (mean, sd) by method; empty if the paper has none."""
    name = re.sub(r"^.*/|-v\d+$|[^A-Za-z]", "", env_id).lower()
    return TABLE_1.get(name, {})


OVER_RUNS = {"mean": ["sd over runs"], "IQM": ["IQM low", "IQM high"]}


def tables(study: Study) -> list[ResultTable]:
    """All tables for which there are runs, the ones that sum up first."""
    made = []
    if study.one_scale:
        made.append(aggregate_table(study))
        if len(study.methods) > 1:
            made.append(improvement_table(study))
    if study.index(CAPACITY) is not None:
        made.append(breaking_table(study))
    made.append(settings_table(study))
    if any(method in table_1(env) for env in study.environments for method in study.methods):
        made.append(paper_table(study))
    return [*made, *comparison_tables(study), diagnostics_table(study), runs_table(study)]


def paper_table(study: Study) -> ResultTable:
    """The paper's Table 1 beside the runs of its methods and of others, at the paper's setting."""
    rows: list[list[Value]] = []
    for env in study.environments:
        column = table_1(env)
        setting = tuple(
            env if axis == "env.id" else value for axis, value in zip(study.axes, study.reference, strict=True)
        )
        for method in study.methods:
            if runs := study.compared(method, setting):
                rows.append([env, method, *column.get(method, (None, None)), *_over_runs(runs), *_lengths(runs)])
    columns = [
        *("environment", "method", "paper mean", "paper sd"),
        *("mean", "sd over runs", "sd of 100 episodes", "IQM", "IQM low", "IQM high", "runs", "seeds"),
        *("episodes", "env steps"),
    ]
    at = label(study, study.reference)
    note = (
        f"{_last_episodes(study)} mean, sd over runs: of the runs' means; sd of 100 episodes: within a run, then mean "
        "over runs; IQM: interquartile mean over runs with its 95 % bootstrap interval over seeds."
        + (f" Runs at {at}, the values nearest to the preset's." if at else "")
    )
    spreads = {"paper mean": ["paper sd"], **OVER_RUNS}
    return ResultTable("table1", "The paper's Table 1 beside these runs", columns, rows, note, spreads)


def settings_table(study: Study) -> ResultTable:
    """Scores of every method at every setting."""
    rows = [[method, *plain(setting), *_over_runs(runs)] for method, setting, runs in _groups(study)]
    columns = [
        *("method", *study.axes, "mean", "sd over runs", "sd of 100 episodes", "IQM", "IQM low", "IQM high"),
        *("runs", "seeds"),
    ]
    note = (
        f"{_last_episodes(study)} mean, sd over runs: of the runs' means; sd of 100 episodes: within a run, then mean "
        "over runs; IQM: interquartile mean over runs with its 95 % bootstrap interval over seeds."
    )
    return ResultTable("settings", "Every setting", columns, rows, note, OVER_RUNS)


def diagnostics_table(study: Study) -> ResultTable:
    """What the buffer handed out and what became of the networks, for every method at every setting."""
    diagnostics = diagnostics_of(study)
    rows: list[list[Value]] = [
        [method, *plain(setting), *(float(np.mean([diagnostic(run, name) for run in runs])) for name in diagnostics)]
        for method, setting, runs in _groups(study)
    ]
    note = (
        "Means over the second half of the runs, evicted_unsampled at their end; sample age in environment steps. "
        "docs/policies.md explains the columns."
    )
    return ResultTable("diagnostics", "Diagnostics", ["method", *study.axes, *diagnostics], rows, note)


def breaking_table(study: Study) -> ResultTable:
    """The breaking point of each method with a replay buffer for each setting of the other axes."""
    place = study.index(CAPACITY)
    assert place is not None
    largest = max(setting[place] for setting in study.settings)
    rows = []
    for others in other_settings(study, CAPACITY):
        for method in study.buffered:
            capacities, scores = along(study, CAPACITY, method, others)
            rows.append([*plain(others), method, *_breaking(capacities, scores, largest)])
    names = [axis for axis in study.axes if axis != CAPACITY]
    columns = [*names, "method", "breaking point", "low", "high", "gaps", "largest", "return there", "runs each"]
    note = (
        "Breaking point: the smallest capacity with at least 95 % of the return at the largest, by the mean over runs; "
        "low and high: its 95 % bootstrap interval over seeds (none for one seed). gaps: some larger capacity falls "
        "below 95 %. Where the return at the largest is poor, nothing was learnt that could break. Empty: no run at "
        "the largest."
    )
    spreads = {"breaking point": ["low", "high"]}
    return ResultTable("breaking_points", "Breaking points", columns, rows, note, spreads)


def aggregate_table(study: Study) -> ResultTable:
    """Interquartile mean over all settings."""
    rows: list[list[Value]] = []
    for method, scores in matrices(study).items():
        interval = iqm_overall(scores)
        values = [float(interval.value[0]), float(interval.low[0]), float(interval.high[0])]
        rows.append([method, *values, len(scores), scores.shape[1], scores.size])
    columns = ["method", "IQM", "low", "high", "seeds", "settings", "runs"]
    note = _matrix_note(study)
    return ResultTable("aggregate", "Over all settings", columns, rows, note, {"IQM": ["low", "high"]})


def improvement_table(study: Study) -> ResultTable:
    """Probability that a run of one method is better than one of another."""
    rows: list[list[Value]] = []
    scores = matrices(study)
    for x, y in pairs(list(scores)):
        interval = improvement(scores[x], scores[y])
        values = [float(interval.value[0]), float(interval.low[0]), float(interval.high[0])]
        rows.append([x, y, *values, len(scores[x]), len(scores[y]), scores[x].shape[1]])
    columns = ["x", "y", "P(x > y)", "low", "high", "seeds of x", "seeds of y", "settings"]
    note, spreads = _matrix_note(study), {"P(x > y)": ["low", "high"]}
    return ResultTable("improvement", "Probability of improvement", columns, rows, note, spreads)


def runs_table(study: Study) -> ResultTable:
    """Every run."""
    diagnostics = diagnostics_of(study)
    rows: list[list[Value]] = [
        [
            *(run.name, run.config.method, run.config.seed, *plain(study.setting(run))),
            *(int(run.end_steps[-1]), len(run.returns), score(run), spread(run)),
            *(diagnostic(run, name) for name in diagnostics),
        ]
        for run in study.runs
    ]
    columns = ["run", "method", "seed", *study.axes, "last step", "episodes", "mean", "sd", *diagnostics]
    note = "mean and sd: of the returns of the last 100 episodes. The CSV file has each run's diagnostics too."
    return ResultTable("runs", "Every run", columns, rows, note, {"mean": ["sd"]}, aside=diagnostics)


def _groups(study: Study) -> Iterator[tuple[str, Setting, list[Run]]]:
    """The runs of every method at every setting."""
    for method in study.methods:
        for setting in study.settings:
            if runs := study.of(method, setting):
                yield method, setting, runs


def _last_episodes(study: Study) -> str:
    """What is averaged: all episodes of a run that has no hundred."""
    short = shorter_runs(study)
    whole = f" (of {short} of the {len(study.runs)} runs all of their episodes, fewer than 100)" if short else ""
    return f"Return of the last 100 training episodes{whole}."


def _over_runs(runs: Sequence[Run]) -> list[Value]:
    """Compute mean, sd over runs, sd within a run, IQM, low, high, runs, seeds."""
    scores = np.array([score(run) for run in runs])
    sd = float(scores.std(ddof=1)) if len(runs) > 1 else None
    within = float(np.mean([spread(run) for run in runs]))
    middle, *bounds = iqm_of(scores)
    ends = bounds if len(runs) > 1 else [None, None]
    return [float(scores.mean()), sd, within, middle, *ends, len(runs), seeds_of(runs)]


def _breaking(capacities: list[int], scores: list[Floats], largest: int) -> list[Value]:
    """Compute breaking point, low, high, gaps, largest, return there, runs each."""
    if not capacities or capacities[-1] != largest:
        return [None, None, None, None, largest, None, None]
    point = breaking_point(np.array(capacities), scores)
    runs = sorted({len(each) for each in scores})
    many = str(runs[0]) if len(runs) == 1 else f"{runs[0]} to {runs[-1]}"
    gaps = "yes" if point.gaps else "no"
    return [point.capacity, point.low, point.high, gaps, largest, float(scores[-1].mean()), many]


def _lengths(runs: Sequence[Run]) -> list[Value]:
    return [float(np.mean([len(run.returns) for run in runs])), float(np.mean([run.end_steps[-1] for run in runs]))]


def _matrix_note(study: Study) -> str:
    return (
        f"Over those of the {len(study.settings)} settings that every method has been run at, and the seeds that a "
        "method has at all of them, with 95 % bootstrap intervals over seeds (none for one seed)."
    )
