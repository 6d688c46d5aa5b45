"""Policies of eviction, which choose the transitions to overwrite, and of sampling: one class per policy."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from coop.replay.table.policies import Eviction, Floats, Rows, Sampling, TableView
from coop.replay.table.sum_tree import make_sum_tree

PRIORITY_FLOOR = 1e-6


class Fifo(Eviction):
    """Evicts the oldest transition; transition i is stored in row i modulo capacity."""

    def place(self, first: int, count: int) -> tuple[Rows, slice]:
        """Assign the next rows of the ring; of a segment longer than the table, only its end is kept."""
        skipped = max(0, count - self.table.capacity)
        return np.arange(first + skipped, first + count) % self.table.capacity, slice(skipped, count)


class Reservoir(Eviction):
    """Holds every transition ever inserted with equal probability (Vitter 1985, algorithm R)."""

    def place(self, first: int, count: int) -> tuple[Rows, Rows]:
        """Draw j from 0..i for transition i (from 0): it gets row j if j < capacity, and is not kept otherwise."""
        rows = np.arange(first, first + count)
        late = max(0, self.table.capacity - first)  # the first position at which the table is full
        rows[late:] = self.table.rng.integers(rows[late:] + 1)
        # Of several transitions for the same row, only the last one is kept.
        last = {row: position for position, row in enumerate(rows.tolist()) if row < self.table.capacity}
        kept = np.array(sorted(last.values()), np.intp)
        return rows[kept], kept


class LowestPriority(Eviction):
    """Evicts the transition with the lowest priority; among equals, the oldest.

    The heap may contain outdated entries: an entry is valid only if it agrees with the table's ids and priorities.
    """

    def __init__(self, table: TableView) -> None:
        super().__init__(table)
        self._heap: list[tuple[float, int, int]] = []

    def place(self, first: int, count: int) -> tuple[Rows, slice]:
        """Assign unused rows, then those of the lowest priorities; new transitions are evicted last."""
        size = min(first, self.table.capacity)
        skipped = max(0, count - self.table.capacity)
        unused = min(self.table.capacity - size, count)
        rows = dict.fromkeys(range(size, size + unused))
        while len(rows) < count - skipped:
            priority, number, row = heapq.heappop(self._heap)
            if self.table.ids[row] == number and self.table.priorities[row] == priority:
                rows.setdefault(row)
        return np.fromiter(rows, np.intp), slice(skipped, count)

    def prioritise(self, rows: Rows) -> None:
        """Add the rows to the heap with their new priorities."""
        if len(self._heap) + len(rows) > 2 * self.table.capacity + 1024:
            held = {row for *_, row in self._heap}
            rows = np.fromiter(held.union(rows.tolist()), np.intp)
            self._heap.clear()
        entries = zip(self.table.priorities[rows].tolist(), self.table.ids[rows].tolist(), rows.tolist(), strict=True)
        for entry in entries:
            heapq.heappush(self._heap, entry)


class Uniform(Sampling):
    """Draws every transition held with equal probability; without replacement, none repeats before all are drawn."""

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """Draw rows; all weights are 1."""
        if self.table.replacement:
            rows = self.table.rng.integers(0, size, count)
        else:
            everything = np.tile(np.arange(size), count // size)
            rows = np.concatenate((everything, self.table.rng.choice(size, count % size, replace=False)))
        weights = np.empty(count, np.float32)
        weights.fill(1)  # np.ones takes three times as long
        return rows, weights


class Proportional(Sampling):
    """P(i) = p_i^alpha / sum_k p_k^alpha, weights (size P(i))^-beta over the batch's largest (Schaul et al. 2016).

    As in that paper, one draw comes from each of `count` equal shares of the sum, so that a transition may be drawn
    twice. Priorities below `PRIORITY_FLOOR` are raised to it, so that every transition can be drawn.
    """

    def __init__(self, table: TableView) -> None:
        super().__init__(table)
        self._tree = make_sum_tree(table.capacity)
        self._alpha, self._beta = table.priority_exponent, table.importance_exponent

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """Draw once from each share, with importance-sampling weights."""
        rows, values = self._tree.draw(self.table.rng.random(count))
        weights = (size * values / self._tree.total) ** -self._beta
        return rows, (weights / weights.max()).astype(np.float32)

    def prioritise(self, rows: Rows, priorities: Floats) -> None:
        """Set p_i^alpha of these rows; if a row repeats, its last priority counts."""
        self._tree.update(rows, np.maximum(priorities, PRIORITY_FLOOR) ** self._alpha)
