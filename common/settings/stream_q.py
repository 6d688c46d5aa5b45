"""Stream Q(lambda) of Elsayed, Vasan and Mahmood (arXiv 2410.14606): learns from each step once and stores none."""

from __future__ import annotations

from dataclasses import dataclass

from coop.common.bounded import Share
from coop.common.settings.conditions import Condition
from coop.common.settings.fields import PositiveFloat, PositiveShare
from coop.common.settings.methods import Method


@dataclass(frozen=True)
class StreamQSettings:
    """Q(lambda) without a replay buffer and a target network (stream-q)."""

    step_size: PositiveFloat = 1.0
    """alpha: step size before it is bounded."""
    overshooting_bound: PositiveFloat = 2.0
    """kappa: the larger, the smaller are the bounded steps."""
    trace_decay: Share = 0.8
    """lambda of the eligibility traces."""
    epsilon_start: Share = 1.0
    """Probability of a random action at the run's beginning."""
    epsilon_final: Share = 0.01
    """Probability of a random action at the end of the linear decay."""
    epsilon_share: PositiveShare = 0.2
    """Length of the decay, as a share of total_steps."""


_UNUSED = (
    *("replay.", "actor.epsilon_start", "actor.epsilon_final", "actor.epsilon_decay", "actor.epsilon_steps"),
    *(
        "network.dtype",
        "learner.batch_size",
        "learner.swap_every",
        "learner.target_update_every",
        "learner.swap_unit",
        "learner.tau",
    ),
    *("learner.loss", "learner.double", "learner.reward_bound", "learner.optimizer", "learner.learning_rate"),
    *("learner.learning_rate_final", "learner.learning_rate_decay", "learner.learning_rate_decay_every"),
    *("learner.momentum", "learner.alpha"),
    *("learner.gradient_alpha", "learner.beta1", "learner.beta2", "learner.eps", "learner.weight_decay"),
    *("learner.device", "learner.tf32"),
)

STREAM_Q = Method(
    "stream-q",
    "one network, gradient, no replay buffer and no target network; lockstep only",
    network="coop.common.networks.sparse:sparse_network",
    stream="coop.learner.methods.stream_q:StreamAgent",
    settings=StreamQSettings,
    conditions=(
        Condition(_UNUSED, lambda c: False, "{c.method} learns from each step once, with settings of its own"),
        Condition(
            ("stream_q.epsilon_share",),
            lambda c: c.method_settings.epsilon_start != c.method_settings.epsilon_final,
            "epsilon begins and ends at {c.method_settings.epsilon_final:g}",
        ),
    ),
    colour="#666666",
)
