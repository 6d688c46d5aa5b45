"""Munchausen-DQN (Vieillard et al. 2020, arXiv 2007.14430): a share of the log-policy is added to the reward.

coop-lockstep --method munchausen:MUNCHAUSEN --munchausen.alpha 0.9
"""

from dataclasses import dataclass

import numpy as np

import coop
from coop.learner.methods.rule import UpdateRule


@dataclass(frozen=True)
class MunchausenSettings:
    """Of the policy softmax(Q / tau) of the target network."""

    alpha: float = 0.9
    """Share of tau ln pi(a|s) that is added to the reward."""
    tau: float = 0.03
    """Temperature of the policy."""
    low: float = -1.0
    """Least value of tau ln pi(a|s) that is added."""


class Munchausen(UpdateRule):
    """y = r + alpha [tau ln pi(a|s)] clipped to [low, 0] + gamma sum_a' pi(a'|s') (Q(s', a') - tau ln pi(a'|s'))."""

    def targets(self, step):
        """All values are the target network's; the last term is the soft maximum tau ln sum exp(Q / tau)."""
        own = self.config.method_settings
        soft, soft_next = (own.tau * np.logaddexp.reduce(q / own.tau, 1) for q in (step.target_q, step.target_q_next))
        taken = step.target_q[np.arange(len(soft)), step.actions] - soft
        return step.rewards + own.alpha * taken.clip(own.low, 0) + step.discounts * soft_next


MUNCHAUSEN = coop.Method(
    "munchausen", "DQN with a share of the log-policy", rule=Munchausen, settings=MunchausenSettings
)
