"""Policies of eviction, which choose the transitions to overwrite, and of sampling: one class per policy."""

from __future__ import annotations

import heapq
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from common.errors import UsageError

Rows = NDArray[np.intp]
Floats = NDArray[np.float64]

PRIORITY_FLOOR = 1e-6


class Eviction(Protocol):
    """Assigns every new transition a row of the table, or none.

    Rows 0..capacity-1 are first filled in order, so after `first` insertions a table holds min(first, capacity)
    transitions in its lowest rows.
    """

    def place(self, first: int, count: int) -> tuple[Rows, slice | Rows]:
        """Assign rows to the transitions numbered first..first+count-1 of all ever inserted.

        Returns (rows, kept): distinct rows, and the (ascending) positions in the segment of the transitions
        that go there. The previous content of a row is evicted; a new transition without a row is not kept.
        """

    def prioritise(self, rows: Rows) -> None:
        """Note that ids or priorities of these rows have changed."""


class Fifo:
    """Evicts the oldest transition; transition i is stored in row i modulo capacity."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity

    def place(self, first: int, count: int) -> tuple[Rows, slice]:
        """Assign the next rows of the ring; of a segment longer than the table, only its end is kept."""
        skipped = max(0, count - self._capacity)
        return np.arange(first + skipped, first + count) % self._capacity, slice(skipped, count)

    def prioritise(self, rows: Rows) -> None:
        """Do nothing: only age matters."""


class Reservoir:
    """Holds every transition ever inserted with equal probability (Vitter 1985, algorithm R)."""

    def __init__(self, capacity: int, rng: np.random.Generator) -> None:
        self._capacity = capacity
        self._rng = rng

    def place(self, first: int, count: int) -> tuple[Rows, Rows]:
        """Draw j from 0..i for transition i (from 0): it gets row j if j < capacity, and is not kept otherwise."""
        rows = np.arange(first, first + count)
        late = max(0, self._capacity - first)  # the first position at which the table is full
        if late < count:
            rows[late:] = self._rng.integers(0, rows[late:] + 1)
        # Of several transitions for the same row, only the last one is kept.
        last = {row: position for position, row in enumerate(rows.tolist()) if row < self._capacity}
        kept = np.fromiter(sorted(last.values()), np.intp, len(last))
        return rows[kept], kept

    def prioritise(self, rows: Rows) -> None:
        """Do nothing: only chance matters."""


class LowestPriority:
    """Evicts the transition with the lowest priority; among equals, the oldest.

    `ids` int64 [capacity] and `priorities` float64 [capacity] belong to the table, which keeps them up to date.
    The heap may contain outdated entries: an entry is valid only if it agrees with these two arrays.
    """

    def __init__(self, ids: NDArray[np.int64], priorities: Floats) -> None:
        self._capacity = len(ids)
        self._ids = ids
        self._priorities = priorities
        self._heap: list[tuple[float, int, int]] = []

    def place(self, first: int, count: int) -> tuple[Rows, slice]:
        """Assign unused rows, then those of the lowest priorities; new transitions are evicted last."""
        size = min(first, self._capacity)
        skipped = max(0, count - self._capacity)
        unused = min(self._capacity - size, count - skipped)
        rows = dict.fromkeys(range(size, size + unused))
        while len(rows) < count - skipped:
            priority, number, row = heapq.heappop(self._heap)
            if self._ids[row] == number and self._priorities[row] == priority:
                rows[row] = None
        return np.fromiter(rows, np.intp, len(rows)), slice(skipped, count)

    def prioritise(self, rows: Rows) -> None:
        """Add the rows to the heap with their new priorities."""
        if len(self._heap) + len(rows) > 2 * self._capacity + 1024:
            live = {entry[2] for entry in self._heap if self._ids[entry[2]] == entry[1]}
            rows = np.fromiter(live | set(rows.tolist()), np.intp)
            self._heap.clear()
        entries = zip(self._priorities[rows].tolist(), self._ids[rows].tolist(), rows.tolist(), strict=True)
        for entry in entries:
            heapq.heappush(self._heap, entry)


class Sampling(Protocol):
    """Draws rows of the table, with importance-sampling weights."""

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """Draw rows intp [count] among 0..size-1, with weights float32 [count] (largest: 1)."""

    def prioritise(self, rows: Rows, priorities: Floats) -> None:
        """Set the priorities of these rows."""


class Uniform:
    """Draws every transition held with equal probability; without replacement, none repeats before all are drawn."""

    def __init__(self, rng: np.random.Generator, *, replacement: bool) -> None:
        self._rng = rng
        self._replacement = replacement

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """Draw rows; all weights are 1."""
        if self._replacement:
            rows = self._rng.integers(0, size, count)
        else:
            everything = np.tile(np.arange(size), count // size)
            rows = np.concatenate((everything, self._rng.choice(size, count % size, replace=False)))
        return rows, np.ones(count, np.float32)

    def prioritise(self, rows: Rows, priorities: Floats) -> None:
        """Do nothing: priorities do not matter."""


class Proportional:
    """P(i) = p_i^alpha / sum_k p_k^alpha, weights (size P(i))^-beta over the batch's largest (Schaul et al. 2016).

    As in that paper, one draw comes from each of `count` equal shares of the sum, so that a transition may be drawn
    twice. Priorities below `PRIORITY_FLOOR` are raised to it, so that every transition can be drawn.
    """

    def __init__(self, capacity: int, rng: np.random.Generator, alpha: float, beta: float) -> None:
        self._tree = SumTree(capacity)
        self._rng = rng
        self._alpha = alpha
        self._beta = beta

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """Draw once from each share, with importance-sampling weights."""
        shares = (np.arange(count) + self._rng.random(count)) / count
        rows = self._tree.find(shares * self._tree.total)
        weights = (size * self._tree.values(rows) / self._tree.total) ** -self._beta
        return rows, (weights / weights.max()).astype(np.float32)

    def prioritise(self, rows: Rows, priorities: Floats) -> None:
        """Set p_i^alpha of these rows; if a row repeats, its last priority counts."""
        self._tree.update(rows, np.maximum(priorities, PRIORITY_FLOOR) ** self._alpha)


class SumTree:
    """Sums of non-negative values, sixteen to a node: values are set and found by running sum in O(log n).

    Every node is always the sum of its sixteen, added from left to right, so the tree depends only on its values, not
    on the order of updates: a restored tree equals the saved one to the bit.
    """

    def __init__(self, capacity: int) -> None:
        self._levels: list[Floats] = []  # [groups, 16], from the values up; the last level has one group
        groups = capacity
        while not self._levels or groups > 1:
            groups = -(-groups // 16)
            self._levels.append(np.zeros((groups, 16)))

    @property
    def total(self) -> float:
        """Sum of all values."""
        return float(self._levels[-1].cumsum()[-1])

    def values(self, rows: Rows) -> Floats:
        """Values at these rows."""
        found: Floats = self._levels[0].reshape(-1)[rows]
        return found

    def update(self, rows: Rows, values: Floats) -> None:
        """Set values; if a row repeats, its last value counts."""
        self._levels[0].reshape(-1)[rows] = values
        for below, above in pairwise(self._levels):
            rows = rows >> 4
            above.reshape(-1)[rows] = below[rows].cumsum(axis=1)[:, -1]

    def find(self, sums: Floats) -> Rows:
        """For each running sum in [0, total), the row whose value covers it; never a row whose value is 0."""
        lines = np.arange(len(sums))
        nodes = np.zeros(len(sums), np.intp)
        for level in reversed(self._levels):
            running = level[nodes].cumsum(axis=1)
            # Rounding may move a sum to the end of its node, which no value covers.
            sums = np.minimum(sums, np.nextafter(running[:, -1], 0))
            child = np.count_nonzero(running <= sums[:, None], axis=1)
            sums = sums - np.where(child > 0, running[lines, child - 1], 0)
            nodes = nodes * 16 + child
        return nodes


EVICTIONS = ("fifo", "reservoir", "prioritized")
SAMPLINGS = ("uniform", "prioritized")


def make_eviction(
    name: str, rng: np.random.Generator, ids: NDArray[np.int64], priorities: Floats
) -> Fifo | Reservoir | LowestPriority:
    """Make the eviction policy of this name for a table of len(ids) rows; raises UsageError for any other name."""
    match name:
        case "fifo":
            return Fifo(len(ids))
        case "reservoir":
            return Reservoir(len(ids), rng)
        case "prioritized":
            return LowestPriority(ids, priorities)
    raise UsageError(f"eviction: {name!r} is not one of {', '.join(EVICTIONS)}")


def make_sampling(
    name: str, rng: np.random.Generator, capacity: int, alpha: float, beta: float, *, replacement: bool
) -> Uniform | Proportional:
    """Make the sampling policy of this name; raises UsageError for any other, or if it needs replacement."""
    match name:
        case "uniform":
            return Uniform(rng, replacement=replacement)
        case "prioritized" if not replacement:
            raise UsageError("sampling: 'prioritized' draws with replacement; without, allowed is uniform")
        case "prioritized":
            return Proportional(capacity, rng, alpha, beta)
    raise UsageError(f"sampling: {name!r} is not one of {', '.join(SAMPLINGS)}")
