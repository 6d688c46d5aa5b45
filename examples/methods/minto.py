"""MINTO (Hendawy et al. 2025, arXiv 2510.02590): y = r + gamma max over a' of min(Q_target(s', a'), Q(s', a')).

coop-lockstep --method minto:Minto
coop-lockstep --method minto:MAXMIN

The same rule with two independent networks, whose roles swap, is Maxmin Q-learning (Lan et al. 2020) with N = 2.
"""

import numpy as np

import coop
from coop.learner.methods.rule import UpdateRule


class Minto(UpdateRule):
    """The smaller of both networks' values, action by action; tells how often that is the trained one's."""

    share = 0.0

    def targets(self, step):
        """See above."""
        self.share = float((step.q_next < step.target_q_next).mean())
        return step.rewards + step.discounts * np.minimum(step.q_next, step.target_q_next).max(1)

    def metrics(self):
        """A column of metrics.jsonl."""
        return {"online_smaller_share": self.share}


MAXMIN = coop.Method("maxmin", "two networks, targets by the smaller value", two_networks=True, rule=Minto)
