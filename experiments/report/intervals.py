"""Statistics over runs with 95 % bootstrap intervals: those of rliable (Agarwal et al. 2021), all resamples at once.

The resamples are stratified: the runs of each task are drawn independently. The same runs give the same intervals.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from experiments.report.study import Floats

REPS = 1000  # bootstrap samples
BOUNDS = (2.5, 97.5)  # percentiles


class Interval(NamedTuple):
    """Estimates with their 95 % bootstrap intervals; float64 arrays of one shape."""

    value: Floats
    low: Floats
    high: Floats


def iqm(scores: Floats) -> Floats:
    """Interquartile mean over runs: float64 [..., runs, tasks] -> [..., tasks]."""
    cut = scores.shape[-2] // 4
    return np.asarray(np.sort(scores, axis=-2)[..., cut : scores.shape[-2] - cut, :].mean(axis=-2))


def iqm_by_task(scores: Floats) -> Interval:
    """Interquartile mean over runs of each task, float64 [tasks]; scores float64 [runs, tasks]."""
    return _interval(iqm(scores), iqm(_resampled(scores, _generator())))


def iqm_overall(scores: Floats) -> Interval:
    """Interquartile mean over all runs and tasks, float64 [1]; scores float64 [runs, tasks]."""
    return _interval(iqm(scores.reshape(-1, 1)), iqm(_resampled(scores, _generator()).reshape(REPS, -1, 1)))


def improvement(x: Floats, y: Floats) -> Interval:
    """Probability that a run of x is better than one of y, mean over tasks, float64 [1]; scores [runs, tasks]."""
    generator, columns = _generator(), np.arange(x.shape[1])
    drawn = [
        _share_better(*(scores[generator.randint(0, len(scores), scores.shape), columns] for scores in (x, y)))
        for _ in range(REPS)
    ]
    return _interval(np.array([_share_better(x, y)]), np.array(drawn)[:, None])


def profiles(scores: Mapping[str, Floats], levels: Floats) -> dict[str, Interval]:
    """Performance profiles: the share of runs above each level, float64 [levels]; scores [runs, tasks] by method."""
    generator = _generator()
    return {
        name: _interval(
            _share_above(each, levels), np.stack([_share_above(s, levels) for s in _resampled(each, generator)])
        )
        for name, each in scores.items()
    }


def _generator() -> np.random.RandomState:
    return np.random.RandomState(0)  # the stream that rliable draws from


def _resampled(scores: Floats, generator: np.random.RandomState) -> Floats:
    """Bootstrap samples, float64 [REPS, runs, tasks], of scores [runs, tasks]."""
    runs = generator.randint(0, len(scores), (REPS, *scores.shape))
    return scores[runs, np.arange(scores.shape[1])]


def _share_better(x: Floats, y: Floats) -> float:
    difference = x[:, None] - y[None, :]
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())


def _share_above(scores: Floats, levels: Floats) -> Floats:
    above = scores.size - np.searchsorted(np.sort(scores, axis=None), levels, side="right")
    return above / scores.size


def _interval(value: Floats, drawn: Floats) -> Interval:
    """value: float64 [values]. drawn: that of each bootstrap sample, float64 [REPS, values]."""
    low, high = np.percentile(drawn, BOUNDS, axis=0)
    return Interval(value, low, high)
