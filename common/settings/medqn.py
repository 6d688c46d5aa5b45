"""MeDQN of Lan, Pan, Luo and Mahmood (arXiv 2205.10868): DQN that consolidates the target network's knowledge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from coop.common.settings.conditions import Condition
from coop.common.settings.fields import NonNegative, Positive
from coop.common.settings.methods import Method


@dataclass(frozen=True)
class MedqnSettings:
    """Value-based knowledge consolidation (medqn): lambda * mean over states of sum_a (Q(s, a) - Q_target(s, a))^2."""

    states: Literal["uniform", "real"] = "uniform"
    """uniform: drawn between the smallest and the largest value seen in each dimension; real: those of the batch."""
    lambda_start: NonNegative = 0.01
    """lambda at the first update."""
    lambda_end: NonNegative = 1.0
    """lambda at the last update of the whole run; linear between."""
    epochs: Positive = 1
    """Steps of the optimizer with each batch, each with states of its own if they are uniform."""


MEDQN = Method(
    "medqn",
    "one network and its copy, gradient, stays near the copy",
    rule="coop.learner.methods.medqn:Consolidation",
    settings=MedqnSettings,
    conditions=(
        Condition(
            ("medqn.states",),
            lambda c: c.method_settings.lambda_start + c.method_settings.lambda_end > 0,
            "lambda is 0 throughout",
        ),
    ),
    colour="#332288",
)
