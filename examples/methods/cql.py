"""The penalty of conservative Q-learning (Kumar et al. 2020, arXiv 2006.04779) on DQN: CQL(H) for discrete actions.

coop-lockstep --method cql:CQL --cql.weight 1
"""

from dataclasses import dataclass

import coop
from coop.learner.methods.rule import UpdateRule


@dataclass(frozen=True)
class CqlSettings:
    """Of the penalty."""

    weight: float = 1.0
    """Weight of log sum exp Q(s, .) - Q(s, a), the mean over the batch."""


class Conservative(UpdateRule):
    """Lowers the values of actions that the table does not hold."""

    def extra_cost(self, step, q):
        """In PyTorch, with a gradient by autograd."""
        taken = q.gather(1, step.actions[:, None])[:, 0]
        return self.config.method_settings.weight * (q.logsumexp(1) - taken).mean()


CQL = coop.Method("cql", "DQN with CQL's penalty", rule=Conservative, settings=CqlSettings)
