"""Keeps observations of many kinds, by the signs of random projections (SimHash): the commonest kind gives way.

coop-lockstep --replay.eviction hashed_coverage:Coverage --replay.capacity 500
"""

import numpy as np

from coop.replay.table.policies import Eviction

BITS, SHARE = 12, 0.05  # kinds: 2^12; a full table refuses more of a kind that fills this share of it


class Coverage(Eviction):
    """Evicts the oldest row of the commonest kind."""

    def admit(self, incoming):
        """Place transitions one at a time, for each changes what is common."""
        table, size, placed = self.table, self.table.size, {}
        kinds = np.full(table.capacity, -1)
        kinds[:size] = self.kinds(table.observations(np.arange(size)))
        for place, kind in enumerate(self.kinds(incoming.observations())):
            row = len(kinds) - np.count_nonzero(kinds == -1)  # the first unused one
            if row == table.capacity:
                if (kinds == kind).mean() >= SHARE:
                    continue
                found, counts = np.unique(kinds, return_counts=True)
                common = np.flatnonzero(kinds == found[counts.argmax()])
                row = int(common[table.ids[common].argmin()])
            placed.pop(row, None)
            placed[row], kinds[row] = place, kind
        return np.array([*placed], np.intp), np.array([*placed.values()], np.intp)

    def kinds(self, observations):
        """A number for each observation."""
        flat = observations.reshape(len(observations), int(np.prod(observations.shape[1:]))).astype(np.float64)
        signs = flat @ np.random.default_rng(0).standard_normal((flat.shape[1], BITS)) > 0
        return signs @ (1 << np.arange(BITS))
