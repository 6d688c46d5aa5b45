"""Tables that compare methods: the course of learning, paired differences, and the effect of the buffer's size."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from coop.common.settings.config import value_of
from coop.studies.report.intervals import over_seeds
from coop.studies.report.learning import (
    area,
    by_seed,
    course,
    differences,
    end_of_running_mean,
    reward_threshold,
    squared_gap_of_means,
)
from coop.studies.report.measures import first_enough, score
from coop.studies.report.slices import CAPACITY, along, label, other_settings, pairs, seeds_of
from coop.studies.report.study import Run, Setting, Study
from coop.studies.report.table import ResultTable, Value, plain

MEASURES = {"return of the last 100": score, "area": area}
BOUNDS = ("low", "high")
LATER = "These measures were chosen after the data of the studies of CartPole had been seen."


def comparison_tables(study: Study) -> list[ResultTable]:
    """All tables of this module for which there are runs."""
    made = [learning_table(study)]
    if not study.one_scale:
        return made
    if len(study.methods) > 1:
        made.append(paired_table(study))
    if study.index(CAPACITY) is not None:
        made += [sizes_table(study), common_breaking_table(study)]
        if len(study.methods) > 1:
            made.append(interaction_table(study))
    return made


def learning_table(study: Study) -> ResultTable:
    """The course of learning of every method at every setting, with the number of diverged runs."""
    diverged: list[tuple[str, Setting]] = [
        (config.method, study.setting_of(config)) for config in study.diverged.values()
    ]
    places = dict.fromkeys([*((m, s) for m in study.methods for s in study.settings), *diverged])
    rows = [
        [method, *plain(setting), *_course(study.of(method, setting)), diverged.count((method, setting))]
        for method, setting in places
        if study.of(method, setting) or (method, setting) in diverged
    ]
    columns = [
        *("method", *study.axes, "area", "sd over runs", "steps to threshold", "reached", "share above"),
        *("collapses", "collapses per 10,000 healthy steps", "running mean", "sd of running mean", "squared Q gap"),
        *("runs", "seeds", "diverged"),
    ]
    bounds = ", ".join(f"{env}: {_threshold(env)}" for env in study.environments)
    note = (
        "area: mean over environment steps of the running mean of 100 episodes. The next five by the running mean of "
        f"20 episodes against gymnasium's threshold ({bounds}): median of the steps until a run reaches it (none where "
        "most never do) and how many runs do; share of the steps afterwards at or above it; falls a run from there to "
        "below 10/13 of it, and falls in 10,000 steps between reaching and falling. running mean: the 100-episode "
        "running mean over the last 100 episodes, its mean and its sd within a run. squared Q gap: median over runs of "
        "the squared difference of the two mean Q-values over the last 100 episodes. diverged: runs that count nowhere "
        f"else. {LATER}"
    )
    spreads = {"area": ["sd over runs"], "running mean": ["sd of running mean"]}
    return ResultTable("learning", "The course of learning", columns, rows, note, spreads)


def paired_table(study: Study) -> ResultTable:
    """Differences between methods over the same seeds, at each setting and over all shared settings."""
    rows: list[list[Value]] = []
    for name, measure in MEASURES.items():
        values = by_seed(study, measure)
        for x, y in pairs(study.methods):
            apart = differences(values, x, y)
            for at in [*apart.columns, None] if len(apart.columns) > 1 else [None]:
                estimate = over_seeds((apart.mean(axis="columns") if at is None else apart[at]).to_numpy())
                where = "all" if at is None else label(study, study.settings[at])
                rows.append([name, where, x, y, *estimate, len(apart)])
    columns = ["measure", "setting", "x", "y", "x - y", "low", "high", "seeds"]
    note = f"Mean over seeds that both methods have, 95 % t interval over seeds. {LATER}"
    return ResultTable("paired", "Differences over the same seeds", columns, rows, note, {"x - y": BOUNDS})


def sizes_table(study: Study) -> ResultTable:
    """The mean return of every method with the smaller and with the larger half of the capacities."""
    rows: list[list[Value]] = []
    values = by_seed(study, score)
    for others in _slices(study):
        small, large = _halves(study, others)
        for method in study.buffered:
            whole = values[method].reindex(columns=[*small, *large]).dropna()
            low, high = whole[small].mean(axis="columns"), whole[large].mean(axis="columns")
            rows.append([_words(study, others), method, low.mean(), high.mean(), *over_seeds(high - low), len(whole)])
    columns = ["setting", "method", "small", "large", "large - small", "low", "high", "seeds"]
    spreads = {"large - small": BOUNDS}
    return ResultTable("sizes", "Small against large buffers", columns, rows, _sizes_note(study), spreads)


def interaction_table(study: Study) -> ResultTable:
    """The difference between two methods in small buffers minus that in large ones."""
    rows: list[list[Value]] = []
    for name, measure in MEASURES.items():
        values = by_seed(study, measure)
        for others in _slices(study):
            small, large = _halves(study, others)
            for x, y in pairs(study.buffered):
                apart = differences(values, x, y).reindex(columns=[*small, *large]).dropna()
                low, high = apart[small].mean(axis="columns"), apart[large].mean(axis="columns")
                where = _words(study, others)
                rows.append([name, where, x, y, low.mean(), high.mean(), *over_seeds(low - high), len(apart)])
    columns = ["measure", "setting", "x", "y", "x - y, small", "x - y, large", "interaction", "low", "high", "seeds"]
    spreads = {"interaction": BOUNDS}
    return ResultTable("interaction", "Size and method", columns, rows, _sizes_note(study), spreads)


def common_breaking_table(study: Study) -> ResultTable:
    """Breaking points of all methods against a common threshold."""
    rows: list[list[Value]] = []
    for others in other_settings(study, CAPACITY):
        found = {method: along(study, CAPACITY, method, others) for method in study.methods}
        largest = max(capacity for capacities, _ in found.values() for capacity in capacities)
        best = max(scores[-1].mean() for capacities, scores in found.values() if capacities[-1:] == [largest])
        for method, (capacities, scores) in found.items():
            if capacities:
                capacity, low, high = first_enough(np.array(capacities), scores, best)
                rows.append([*plain(others), method, best, capacity, low, high])
    names = [axis for axis in study.axes if axis != CAPACITY]
    note = (
        "The smallest capacity at which the mean over runs is at least 95 % of the best method's at the largest "
        f"capacity; 95 % bootstrap interval over seeds (none for one seed). Empty: at none. {LATER}"
    )
    columns = [*names, "method", "best return", "breaking point", "low", "high"]
    spreads = {"breaking point": BOUNDS}
    return ResultTable("common_breaking", "Breaking points against one threshold", columns, rows, note, spreads)


def _course(runs: Sequence[Run]) -> list[Value]:
    """Compute the columns of `learning_table` from area to seeds."""
    if not runs:
        return [*[None] * 10, 0, "none"]
    areas = np.array([area(run) for run in runs])
    threshold = reward_threshold(runs[0].config.env.id)
    ends = [end_of_running_mean(run) for run in runs]
    gap = float(np.median([squared_gap_of_means(run) for run in runs]))
    return [
        *(float(areas.mean()), float(areas.std(ddof=1)) if len(runs) > 1 else None),
        *([None] * 5 if threshold is None else _against(runs, threshold)),
        *(float(np.mean([end.mean() for end in ends])), float(np.mean([end.std() for end in ends]))),
        *(gap, len(runs), seeds_of(runs)),
    ]


def _against(runs: Sequence[Run], threshold: float) -> list[Value]:
    courses = [course(run, threshold) for run in runs]
    reached = [each for each in courses if math.isfinite(each.steps_to)]
    median, healthy = float(np.median([each.steps_to for each in courses])), sum(each.healthy_steps for each in courses)
    shares = [each.share_above for each in reached if not math.isnan(each.share_above)]
    collapses = sum(each.collapses for each in courses)
    return [
        median if math.isfinite(median) else None,
        len(reached),
        float(np.mean(shares)) if shares else None,
        collapses / len(runs),
        10_000 * collapses / healthy if healthy else None,
    ]


def _threshold(environment: str) -> str:
    threshold = reward_threshold(environment)
    return "none" if threshold is None else f"{threshold:g}"


def _halves(study: Study, others: Setting | None) -> tuple[list[int], list[int]]:
    """Indices of the settings with the smaller and the larger half of the capacities; of all other axes if None."""
    place = study.axes.index(CAPACITY)
    sizes = sorted({setting[place] for setting in study.settings if setting[place]})
    split = sizes[math.ceil(len(sizes) / 2) - 1]
    chosen = [
        (number, setting[place] <= split)
        for number, setting in enumerate(study.settings)
        if setting[place] and (others is None or setting[:place] + setting[place + 1 :] == others)
    ]
    return [number for number, small in chosen if small], [number for number, small in chosen if not small]


def _slices(study: Study) -> list[Setting | None]:
    """The settings of the axes other than capacity, and None for all of them together if there are several."""
    others = other_settings(study, CAPACITY)
    return [*others, None] if len(others) > 1 else [*others]


def _words(study: Study, others: Setting | None) -> str:
    names = [axis.rpartition(".")[2] for axis in study.axes if axis != CAPACITY]
    return "all" if not others else ", ".join(f"{n} {value}" for n, value in zip(names, others, strict=True))


def _sizes_note(study: Study) -> str:
    sizes = sorted({int(value_of(run.config, CAPACITY)) for run in study.runs if not run.config.streaming})
    half = math.ceil(len(sizes) / 2)
    small, large = (", ".join(map(str, part)) for part in (sizes[:half], sizes[half:]))
    seeds = "Means over the seeds that have all of them, 95 % t intervals over seeds."
    return f"small: capacities {small}; large: {large}. {seeds} {LATER}"
