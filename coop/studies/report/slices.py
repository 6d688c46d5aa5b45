"""Parts of a study: runs along one axis, scores of settings and seeds that methods share, and their labels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from coop.studies.report.measures import score
from coop.studies.report.study import Floats, Run, Setting, Study

CAPACITY = "replay.capacity"


def label(study: Study, setting: Setting) -> str:
    """A setting in words."""
    return ", ".join(f"{axis.rpartition('.')[2]} {value}" for axis, value in zip(study.axes, setting, strict=True))


def other_settings(study: Study, axis: str) -> list[Setting]:
    """The settings of all axes but one, in order."""
    place = study.axes.index(axis)
    return list(dict.fromkeys(setting[:place] + setting[place + 1 :] for setting in study.settings))


def along(
    study: Study, axis: str, method: str, others: Setting, measure: Callable[[Run], float] = score
) -> tuple[list[int], list[Floats]]:
    """The values of one axis, others fixed, at which a method has runs, and a measure of the runs at each value."""
    place = study.axes.index(axis)
    settings = [s for s in study.settings if s[:place] + s[place + 1 :] == others and study.compared(method, s)]
    measured = [np.array([measure(run) for run in study.compared(method, setting)]) for setting in settings]
    return [setting[place] for setting in settings], measured


def matrices(study: Study) -> dict[str, Floats]:
    """Scores float64 [seeds, settings] of each method, over the settings and seeds that all methods have.

    If settings of the replay buffer differ, methods without one are left out: they have one set of runs for all sizes.
    """
    methods = study.buffered if any(axis.startswith("replay.") for axis in study.axes) else study.methods
    scores = study.frame.assign(score=study.frame["run"].map(score))
    tables = {
        method: scores[scores["method"] == method].pivot_table("score", "seed", "setting", aggfunc="last")
        for method in methods
    }
    shared = sorted(set.intersection(*(set(table.columns) for table in tables.values())))
    whole = {method: table.reindex(columns=shared).dropna().to_numpy() for method, table in tables.items()}
    return {method: matrix for method, matrix in whole.items() if matrix.size}


def pairs(methods: Sequence[str]) -> list[tuple[str, str]]:
    """All pairs of methods, with the later one in the paper's table first."""
    return [(x, y) for i, x in enumerate(methods) for y in methods[:i]]


def counts(runs: Sequence[Run]) -> str:
    """The numbers of runs and the seeds by method: "dqn: 12 runs, seeds 0,1; coop: 6 runs, seeds 0-2"."""
    distinct = list({run.name: run for run in runs}.values())
    by_method = pd.Series(distinct, dtype=object).groupby([run.config.method for run in distinct], sort=False)
    return "; ".join(f"{method}: {len(group)} runs, seeds {seeds_of(list(group))}" for method, group in by_method)


def seeds_of(runs: Sequence[Run]) -> str:
    """Seeds in compact form: "0-9", "0,2,5"."""
    seeds = sorted({run.config.seed for run in runs})
    if len(seeds) > 2 and seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]}-{seeds[-1]}"
    return ",".join(map(str, seeds)) or "none"
