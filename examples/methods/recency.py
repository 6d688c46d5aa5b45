"""Two ways to draw new transitions more often.

coop-lockstep --replay.sampling recency:Combined
coop-lockstep --replay.sampling recency:Geometric

Combined experience replay (Zhang and Sutton 2017, arXiv 1712.01275), and a truncated geometric distribution over ages.
"""

import numpy as np

from coop.replay.table.policies import Sampling

MEAN_AGE = 0.25  # of the geometric distribution, as a share of what the table holds


class Combined(Sampling):
    """The newest transition is in every batch, the others are drawn uniformly."""

    def draw(self, count, size):
        """Draw all but one."""
        rows = self.table.rng.integers(0, size, count)
        rows[0] = self.table.ids[:size].argmax()
        return rows, np.ones(count, np.float32)


class Geometric(Sampling):
    """P(age) falls by the same factor from each age to the next, and is 0 beyond the oldest one held."""

    def draw(self, count, size):
        """Draw ages by the inverse of their distribution, and find their rows."""
        keep = 1 - 1 / max(MEAN_AGE * size, 1.001)
        chance = self.table.rng.random(count) * (1 - keep**size)
        age = np.minimum(np.log1p(-chance) / np.log(keep), size - 1).astype(np.intp)
        return np.argsort(-self.table.ids[:size])[age], np.ones(count, np.float32)
