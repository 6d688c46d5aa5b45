"""Parts of a study: the runs along one axis, the scores that methods share, and their names in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from experiments.report.measures import score
from experiments.report.study import Floats, Run, Setting, Study

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
    """The values of one axis at which a method has runs, the other axes fixed, and a measure of the runs at each."""
    place = study.axes.index(axis)
    found = [
        (setting[place], np.array([measure(run) for run in study.of(method, setting)]))
        for setting in study.settings
        if setting[:place] + setting[place + 1 :] == others
    ]
    found = [(value, measured) for value, measured in found if len(measured)]
    return [value for value, _ in found], [measured for _, measured in found]


def matrices(study: Study) -> dict[str, Floats]:
    """Scores float64 [seeds, settings] of each method: settings that all methods have, seeds that all of those have."""
    settings = [s for s in study.settings if all(study.of(method, s) for method in study.methods)]
    made = {}
    for method in study.methods:
        by_seed = [{run.config.seed: score(run) for run in study.of(method, setting)} for setting in settings]
        seeds = sorted(set.intersection(*map(set, by_seed))) if by_seed else []
        if seeds:
            made[method] = np.array([[scores[seed] for scores in by_seed] for seed in seeds])
    return made


def pairs(methods: Sequence[str]) -> list[tuple[str, str]]:
    """Every two methods, the later one of the paper's table first."""
    return [(x, y) for i, x in enumerate(methods) for y in methods[:i]]


def counts(runs: Sequence[Run]) -> str:
    """How many runs of which seeds: "dqn: 12 runs, seeds 0,1; coop: 6 runs, seeds 0-2"."""
    by_method: dict[str, list[Run]] = {}
    for run in runs:
        by_method.setdefault(run.config.method, []).append(run)
    return "; ".join(f"{method}: {len(group)} runs, seeds {seeds_of(group)}" for method, group in by_method.items())


def seeds_of(runs: Sequence[Run]) -> str:
    """Seeds in few characters: "0-9", "0,2,5"."""
    seeds = sorted({run.config.seed for run in runs})
    if len(seeds) > 2 and seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]}-{seeds[-1]}"
    return ",".join(map(str, seeds)) or "none"
