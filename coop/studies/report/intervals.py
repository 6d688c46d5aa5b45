"""Statistics over runs with 95 % intervals: those of rliable (Agarwal et al. 2021), for as few seeds as studies have.

A mean over seeds has a t interval. Of other statistics whole seeds are resampled, since the runs of one seed at several
settings are no independent ones, and the percentiles are widened for the number of seeds: plain ones cover 83 % with
five seeds and 90 % with ten. Such an interval never leaves the range of the data, as that of t does at a game's cap.
The same runs give the same intervals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from coop.studies.report.study import Floats

REPS = 2000  # bootstrap samples
OUTSIDE = 0.025  # share of a distribution beyond each end of an interval


class Interval(NamedTuple):
    """Estimates with their 95 % intervals, which are nan for one seed; float64 arrays of one shape."""

    value: Floats
    low: Floats
    high: Floats


class Estimate(NamedTuple):
    """A statistic over seeds with its 95 % interval; nan if there are too few seeds."""

    value: float
    low: float
    high: float


def over_seeds(values: Sequence[float] | Floats) -> Estimate:
    """The mean over seeds with its t interval."""
    sample = np.asarray(values, np.float64)
    if len(sample) < 2:
        return Estimate(float(sample.mean()) if len(sample) else math.nan, math.nan, math.nan)
    mean = float(sample.mean())
    wide = float(_student(len(sample)) * sample.std(ddof=1)) / math.sqrt(len(sample))
    return Estimate(mean, mean - wide, mean + wide)


def tail(seeds: int) -> float:
    """The share of bootstrap samples beyond each end of an interval over two seeds or more: below OUTSIDE for few.

    For a mean the percentiles are then as wide as the t interval (Hesterberg 2015, section 5.3).
    """
    return float(ndtr(-math.sqrt(seeds / (seeds - 1)) * _student(seeds)))


def drawn_seeds(seeds: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Bootstrap samples of seeds, int64 [REPS, seeds]."""
    return generator.integers(0, seeds, (REPS, seeds))


def iqm(scores: Floats) -> Floats:
    """Interquartile mean over runs: float64 [..., runs, tasks] -> [..., tasks]."""
    cut = scores.shape[-2] // 4
    return np.asarray(np.sort(scores, axis=-2)[..., cut : scores.shape[-2] - cut, :].mean(axis=-2))


def iqm_by_task(scores: Floats) -> Interval:
    """Interquartile mean over runs of each task, float64 [tasks]; scores float64 [runs, tasks]."""
    return _interval(iqm(scores), iqm(_resampled(scores, _generator())), len(scores))


def iqm_of(scores: Floats) -> Estimate:
    """Interquartile mean over runs, float64 [runs], without an interval for one run."""
    found = iqm_by_task(scores[:, None])
    return Estimate(float(found.value[0]), float(found.low[0]), float(found.high[0]))


def iqm_overall(scores: Floats) -> Interval:
    """Interquartile mean over all runs and tasks, float64 [1]; scores float64 [seeds, tasks]."""
    drawn = iqm(_resampled(scores, _generator()).reshape(REPS, -1, 1))
    return _interval(iqm(scores.reshape(-1, 1)), drawn, len(scores))


def improvement(x: Floats, y: Floats) -> Interval:
    """Probability that a run of x is better than one of y, mean over tasks, float64 [1]; scores [seeds, tasks]."""
    generator = _generator()
    samples = zip(*(drawn_seeds(len(scores), generator) for scores in (x, y)), strict=True)
    better = _better(x, y)  # of all pairs of seeds, once; a sample is a choice of them
    drawn = [better[np.ix_(of_x, of_y)].mean() for of_x, of_y in samples]
    return _interval(np.array([better.mean()]), np.array(drawn)[:, None], min(len(x), len(y)))


def profiles(scores: Mapping[str, Floats], levels: Floats) -> dict[str, Interval]:
    """Performance profiles: the share of runs above each level, float64 [levels]; scores [seeds, tasks] by method."""
    generator = _generator()
    return {
        name: _interval(
            _share_above(each, levels),
            np.stack([_share_above(s, levels) for s in _resampled(each, generator)]),
            len(each),
        )
        for name, each in scores.items()
    }


def _student(seeds: int) -> float:
    """The quantile of t that leaves OUTSIDE beyond it."""
    return float(stdtrit(seeds - 1, 1 - OUTSIDE))


def _generator() -> np.random.Generator:
    return np.random.default_rng(0)


def _resampled(scores: Floats, generator: np.random.Generator) -> Floats:
    """Bootstrap samples of whole seeds, float64 [REPS, seeds, tasks], of scores [seeds, tasks]."""
    return scores[drawn_seeds(len(scores), generator)]


def _better(x: Floats, y: Floats) -> Floats:
    """The share of tasks in which each seed of x is better than each of y, float64 [seeds of x, seeds of y]."""
    difference = x[:, None] - y[None, :]
    return np.asarray(((difference > 0) + 0.5 * (difference == 0)).mean(axis=2))


def _share_above(scores: Floats, levels: Floats) -> Floats:
    above = scores.size - np.searchsorted(np.sort(scores, axis=None), levels, side="right")
    return above / scores.size


def _interval(value: Floats, drawn: Floats, seeds: int) -> Interval:
    """value: float64 [values]. drawn: that of each bootstrap sample, float64 [REPS, values]."""
    if seeds < 2:
        return Interval(value, *np.full((2, *value.shape), math.nan))
    return Interval(value, *np.quantile(drawn, [tail(seeds), 1 - tail(seeds)], axis=0))
