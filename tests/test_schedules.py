"""Schedules on numbers worked out by hand."""

import math

import pytest

from coop.common.settings import schedules
from coop.common.settings.config import ActorSettings, EdlSettings, LearnerSettings


@pytest.mark.parametrize(
    ("decay", "env_step", "expected"),
    [
        ("exponential", 0, 0.9),
        ("exponential", 100, 0.1 + 0.8 / math.e),
        ("exponential", 200, 0.1 + 0.8 / math.e**2),
        ("linear", 0, 0.9),
        ("linear", 25, 0.7),
        ("linear", 100, 0.1),
        ("linear", 500, 0.1),
    ],
)
def test_epsilon(decay: str, env_step: int, expected: float) -> None:
    settings = ActorSettings(epsilon_start=0.9, epsilon_final=0.1, epsilon_decay=decay, epsilon_steps=100)  # type: ignore[arg-type]
    assert schedules.epsilon(settings, env_step) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("stepwise", "update", "expected"),
    [
        (False, 0, 0.1),
        (False, 15, 0.1 * 0.5**1.5),
        (False, 20, 0.025),
        (True, 9, 0.1),
        (True, 10, 0.05),
        (True, 25, 0.025),
    ],
)
def test_exploration_rate(stepwise: bool, update: int, expected: float) -> None:
    settings = EdlSettings(rate=0.1, decay=0.5, decay_every=10, decay_staircase=stepwise)
    assert schedules.feedback_scale(settings, update) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("changes", "update", "planned", "expected"),
    [
        ({}, 150, 200, 2.0),
        ({"learning_rate_final": 0.01}, 0, 200, 2.0),
        ({"learning_rate_final": 0.01}, 100, 200, 0.2),
        ({"learning_rate_final": 0.01}, 200, 200, 0.02),
        ({"learning_rate_final": 0.01}, 600, 200, 0.02),
        ({"learning_rate_final": 0.01}, 0, 1, 2.0),
        ({"learning_rate_final": 0.01}, 0, 0, 2.0),  # of a run whose updates nobody has planned
        ({"learning_rate_final": 0.01}, 1, 0, 0.02),
        ({"learning_rate_decay": 0.8, "learning_rate_decay_every": 10}, 9, 9000, 2.0),
        ({"learning_rate_decay": 0.8, "learning_rate_decay_every": 10}, 20, 9000, 2.0 * 0.64),
        ({"learning_rate_final": 0.25, "learning_rate_decay": 0.8, "learning_rate_decay_every": 10}, 10, 20, 0.8),
    ],
)
def test_learning_rate(changes: dict[str, float], update: int, planned: int, expected: float) -> None:
    settings = LearnerSettings(learning_rate=2.0, **changes)  # type: ignore[arg-type]
    assert schedules.learning_rate(settings, update, planned) == pytest.approx(expected)
