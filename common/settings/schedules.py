"""Schedules of epsilon, s and the learning rate, as pure functions of a count."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # `coop.studies.stacked` runs where the settings' checks are not installed
    from coop.common.settings.config import ActorSettings, EdlSettings, LearnerSettings


def epsilon(settings: ActorSettings, env_step: int) -> float:
    """Probability of a random action after `env_step` environment steps."""
    start, final, progress = settings.epsilon_start, settings.epsilon_final, env_step / settings.epsilon_steps
    if settings.epsilon_decay == "exponential":
        # (epsilon)
        return final + (start - final) * math.exp(-progress)
    return linear(start, final, progress)


def linear(start: float, final: float, progress: float) -> float:
    """Fall (or rise) from `start` to `final` on a straight line; progress: share of the way, 1 or more at its end."""
    return final + (start - final) * max(0.0, 1.0 - progress)


def feedback_scale(settings: EdlSettings, update: int) -> float:
    """The paper's s before any N(0, 1) draw: rate * decay^(update / decay_every), with integer powers if stepwise."""
    power = update // settings.decay_every if settings.decay_staircase else update / settings.decay_every
    # (decay of s)
    return settings.rate * float(settings.decay**power)


def learning_rate(settings: LearnerSettings, update: int, planned: int) -> float:
    """Learning rate of an update, counted from 0, in a run of `planned` updates.

    It falls exponentially to the share learning_rate_final over the run, and is multiplied by learning_rate_decay
    every learning_rate_decay_every updates.
    """
    progress = min(1.0, update / max(1, planned))
    steps = update // settings.learning_rate_decay_every
    return settings.learning_rate * float(settings.learning_rate_final**progress * settings.learning_rate_decay**steps)
