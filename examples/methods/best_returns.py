"""Evicts transitions of the episodes with the lowest return so far, the oldest first.

coop-lockstep --replay.eviction best_returns:BestReturns --replay.capacity 500

An episode's return here is the sum of those of its rewards that the table holds.
"""

import numpy as np

from coop.replay.table.policies import Eviction


class BestReturns(Eviction):
    """Keeps the episodes with the highest returns; what plays now is newest, and goes last among equals."""

    episodes = True

    def place(self, first, count):
        """Fill unused rows, then those of the worst episodes."""
        table, size = self.table, self.table.size
        skipped = max(0, count - table.capacity)
        count -= skipped
        unused = np.arange(size, min(size + count, table.capacity))
        _, number = np.unique(table.episodes[:size], return_inverse=True)
        returns = np.bincount(number, table.rewards[:size])[number] if size else np.empty(0)
        worst = np.lexsort((table.ids[:size], returns))[: count - len(unused)]
        return np.concatenate((unused, worst)), slice(skipped, skipped + count)
