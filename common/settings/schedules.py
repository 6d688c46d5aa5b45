"""Schedules as plain functions of a count: epsilon, s and the learning rate."""

from __future__ import annotations

import math

from common.settings.config import ActorSettings, EdlSettings, LearnerSettings


def epsilon(settings: ActorSettings, env_step: int) -> float:
    """Probability of a random action after `env_step` environment steps."""
    span = settings.epsilon_start - settings.epsilon_final
    if settings.epsilon_decay == "exponential":
        return settings.epsilon_final + span * math.exp(-env_step / settings.epsilon_steps)
    return settings.epsilon_final + span * max(0.0, 1.0 - env_step / settings.epsilon_steps)


def exploration_rate(settings: EdlSettings, update: int) -> float:
    """The paper's s before any N(0, 1) draw: rate * decay^(update / decay_every)."""
    return settings.rate * float(settings.decay ** (update / settings.decay_every))


def learning_rate(settings: LearnerSettings, progress: float) -> float:
    """Learning rate at `progress` in [0, 1] of the run: an exponential fall to learning_rate_final of itself."""
    return settings.learning_rate * float(settings.learning_rate_final ** min(1.0, progress))
