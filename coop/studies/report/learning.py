"""The course of learning over a whole run, and differences between methods over the same seeds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import numpy as np
import pandas as pd

from coop.common.numbers import RETURN_WINDOW, SHORT_WINDOW, running_mean
from coop.studies.report.study import Floats, Run, Study

FALL = 3 / 13  # share of the threshold by which a healthy run must fall to collapse; for CartPole from 195 to 150


class Course(NamedTuple):
    """A run compared with a threshold of return, by the running mean of 20 episodes.

    steps_to: environment steps until it first reached the threshold; inf if it never did. share_above: of the steps
    after that, those at which it was at the threshold or above; nan if it never was. collapses: how often it fell from
    the threshold or above to below 10/13 of it. healthy_steps: steps between reaching the threshold and collapsing.
    """

    steps_to: float
    share_above: float
    collapses: int
    healthy_steps: float


def reward_threshold(environment: str) -> float | None:
    """The return at which gymnasium considers an environment solved; None if it names none."""
    try:
        return gymnasium.spec(environment).reward_threshold
    except gymnasium.error.Error:
        return None


def area(run: Run) -> float:
    """Area under the curve by steps, divided by the steps: the mean over steps of the running mean of 100 episodes.

    Before the first episode's end, its return counts.
    """
    lengths = np.diff(run.end_steps, prepend=0.0)
    latest = np.concatenate((run.returns[:1], running_mean(run.returns)[:-1]))
    return float(np.average(latest, weights=lengths))


def course(run: Run, threshold: float) -> Course:
    """Compute a run's `Course`."""
    means = running_mean(run.returns, SHORT_WINDOW)[SHORT_WINDOW - 1 :]
    steps = run.end_steps[SHORT_WINDOW - 1 :]
    fallen = threshold - FALL * abs(threshold)
    collapses, healthy_steps, since = 0, 0.0, math.nan
    for step, mean in zip(steps, means, strict=True):
        if math.isnan(since) and mean >= threshold:
            since = step
        elif mean < fallen and not math.isnan(since):
            collapses, healthy_steps, since = collapses + 1, healthy_steps + step - since, math.nan
    if not math.isnan(since):
        healthy_steps += steps[-1] - since
    reached = np.flatnonzero(means >= threshold)
    if not len(reached):
        return Course(math.inf, math.nan, 0, 0.0)
    after = np.diff(steps[reached[0] :])
    above = (means[reached[0] : -1] >= threshold) @ after / after.sum() if len(after) else math.nan
    return Course(float(steps[reached[0]]), float(above), collapses, float(healthy_steps))


def end_of_running_mean(run: Run) -> Floats:
    """float64 [100 or fewer]: the running mean of 100 episodes at each of the last 100 episodes."""
    return running_mean(run.returns)[-RETURN_WINDOW:]


def squared_gap_of_means(run: Run) -> float:
    """The squared difference of the two networks' mean Q-values, each over the last 100 episodes."""
    one, other = (float(values[-RETURN_WINDOW:].mean()) for values in (run.q1_means, run.q2_means))
    return (one - other) ** 2


def by_seed(study: Study, measure: Callable[[Run], float]) -> pd.DataFrame:
    """A measure of every run: a row per seed, columns (method, index of the setting); nan if there is no run.

    Runs without a replay buffer count at each setting of the others' buffers.
    """
    measured = study.comparable.assign(value=study.comparable["run"].map(measure))
    return measured.pivot_table("value", "seed", ["method", "setting"], aggfunc="last")


def differences(values: pd.DataFrame, x: str, y: str) -> pd.DataFrame:
    """The difference x - y: a row per seed and a column per setting, of those that both methods have."""
    return (values[x] - values[y]).dropna(axis="columns", how="all").dropna()
