"""The measures that a report computes from runs, curves over runs, and breaking points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop.common.numbers import RETURN_WINDOW
from coop.studies.report.intervals import drawn_seeds, tail
from coop.studies.report.study import CHURN, LATER, Q_SHARE, Floats, Run, Study

ENOUGH = 0.95  # share of the return at the largest capacity that counts as unbroken learning
POINTS = 120  # of a curve
DIAGNOSTICS = ("sample_age_mean", "sample_age_p95", "reuse_mean", "evicted_unsampled")


class Breaking(NamedTuple):
    """The breaking point: the smallest capacity with at least 95 % of the return at the largest.

    low, high: 95 % bootstrap interval of `capacity` over seeds; None where one seed is all there is.
    gaps: a larger capacity is below 95 % again, so the returns are not monotonic.
    """

    capacity: int
    low: int | None
    high: int | None
    gaps: bool


def score(run: Run) -> float:
    """Mean return of the last 100 episodes, the paper's measure."""
    return float(run.returns[-RETURN_WINDOW:].mean())


def shorter_runs(study: Study) -> int:
    """The number of runs with fewer episodes than `score` takes: of these it is the mean return of the whole run."""
    return sum(len(run.returns) < RETURN_WINDOW for run in study.runs)


def spread(run: Run) -> float:
    """Standard deviation of the returns of the last 100 episodes."""
    return float(run.returns[-RETURN_WINDOW:].std())


def diagnostic(run: Run, name: str) -> float:
    """Mean of a diagnostic over the second half of a run; the last value of the share evicted unsampled.

    nan for a run without a row of metrics that has it.
    """
    steps, values = rows_with(run, name)
    if not len(values):
        return float("nan")
    return float(values[-1] if name == "evicted_unsampled" else values[steps >= steps[-1] / 2].mean())


def diagnostics_of(study: Study) -> list[str]:
    """The diagnostics of a study: those of every version, and of the later ones those that a run has."""
    later = (name for name in (*LATER, CHURN, Q_SHARE) if any(len(rows_with(run, name)[1]) for run in study.runs))
    return [*DIAGNOSTICS, *later]


def rows_with(run: Run, name: str) -> tuple[Floats, Floats]:
    """The environment steps of the rows of metrics that have a value, and these values: float64 [rows]."""
    values = run.metrics[name]
    there = ~np.isnan(values)
    return run.metrics["env_step"][there], values[there]


def metrics_by_steps(runs: Sequence[Run], name: str) -> tuple[Floats, Floats]:
    """Curves of a column of metrics on common environment steps: steps float64 [points], curves [runs, points].

    Every run must have a row with it.
    """
    rows = [rows_with(run, name) for run in runs]
    low, high = max(steps[0] for steps, _ in rows), min(steps[-1] for steps, _ in rows)
    at = np.linspace(low, max(low, high), POINTS)
    return at, np.stack([_latest(steps, values, at) for steps, values in rows])


def evaluated_by_steps(runs: Sequence[Run]) -> tuple[Floats, Floats]:
    """Curves of evaluations, of which every run must have some, as `metrics_by_steps`."""
    low, high = max(run.evaluated[0, 0] for run in runs), min(run.evaluated[0, -1] for run in runs)
    at = np.unique(np.concatenate([run.evaluated[0] for run in runs]).clip(low, max(low, high)))
    return at, np.stack([_latest(run.evaluated[0], run.evaluated[1], at) for run in runs])


def by_steps(runs: Sequence[Run], values: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Curves of values per episode on common environment steps: steps float64 [points], curves [runs, points]."""
    low, high = max(run.end_steps[0] for run in runs), min(run.end_steps[-1] for run in runs)
    at = np.linspace(low, max(low, high), POINTS)
    return at, np.stack([_latest(run.end_steps, each, at) for run, each in zip(runs, values, strict=True)])


def by_episodes(values: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Curves of values per episode, up to the shortest run: episodes float64 [points], curves [runs, points]."""
    shortest = min(len(each) for each in values)
    at = np.unique(np.linspace(1, shortest, min(POINTS, shortest)).round())
    return at, np.stack([each[at.astype(np.intp) - 1] for each in values])


def q_gaps(runs: Sequence[Run]) -> tuple[Floats, Floats]:
    """The norm of Q1 - Q2 against episodes: episodes float64 [points], curves [runs, points].

    Every run must have a row of metrics.
    """
    return by_episodes([_latest(run.metrics["env_step"], run.metrics["q_gap"], run.end_steps) for run in runs])


def _latest(steps: Floats, values: Floats, at: Floats) -> Floats:
    """The latest value at each step of `at`; the first value for earlier steps."""
    return values[np.maximum(0, np.searchsorted(steps, at, side="right") - 1)]


def breaking_point(capacities: NDArray[np.int64], scores: Sequence[Floats]) -> Breaking:
    """The breaking point by the mean score over runs.

    Args:
        capacities: int64 [n], ascending.
        scores: for each capacity, float64 [runs]; the numbers of runs may differ.
    """
    enough = _is_enough(np.array([each.mean() for each in scores]))
    first = int(enough.argmax())
    drawn = capacities[_is_enough(_resampled_means(scores)).argmax(axis=1)]
    low, high = _bounds(drawn, scores)
    return Breaking(int(capacities[first]), low, high, not enough[first:].all())


def first_enough(
    capacities: NDArray[np.int64], scores: Sequence[Floats], best: float
) -> tuple[int | None, int | None, int | None]:
    """The smallest capacity whose mean over runs is at least 95 % of `best`, and its 95 % interval over seeds.

    The capacity is None if none is enough; a bound is None if that holds in the bootstrap, or for one seed.
    """
    means = np.vstack([[each.mean() for each in scores], _resampled_means(scores)])
    enough = means >= best - (1 - ENOUGH) * abs(best)
    found = np.where(enough.any(axis=1), capacities[enough.argmax(axis=1)], np.inf)
    return _whole(found[0]), *_bounds(found[1:], scores)


def _resampled_means(scores: Sequence[Floats]) -> Floats:
    """The mean at each capacity in each bootstrap sample, float64 [REPS, capacities], of whole seeds.

    If some capacities have more runs than others, those of each are drawn by themselves.
    """
    generator = np.random.default_rng(0)
    drawn = {len(each): drawn_seeds(len(each), generator) for each in scores}
    return np.stack([each[drawn[len(each)]].mean(axis=1) for each in scores], axis=1)


def _bounds(drawn: NDArray[Any], scores: Sequence[Floats]) -> tuple[int | None, int | None]:
    """The ends of the interval over seeds; None for one seed, and for an end that is infinite."""
    seeds = min(map(len, scores))
    if seeds < 2:
        return None, None
    low, high = np.quantile(drawn, [tail(seeds), 1 - tail(seeds)], method="nearest")
    return _whole(low), _whole(high)


def _whole(capacity: float) -> int | None:
    return int(capacity) if np.isfinite(capacity) else None


def _is_enough(means: Floats) -> NDArray[np.bool_]:
    """Whether each mean [..., capacities] is at least 95 % of the last one (if negative: within 5 % of its size)."""
    largest = means[..., -1:]
    return np.asarray(means >= largest - (1 - ENOUGH) * np.abs(largest))
