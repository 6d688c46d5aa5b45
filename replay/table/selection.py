"""Which transitions a full table gives up (eviction) and which it draws (sampling): one small class per policy."""

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
    """Gives every new transition a row of the table, or none.

    Rows 0..capacity-1 are filled in order first, so a table that has had `first` transitions holds
    min(first, capacity) of them in its lowest rows.
    """

    def place(self, first: int, count: int) -> tuple[Rows, slice | Rows]:
        """Rows for the transitions numbered first..first+count-1 of all ever inserted.

        Returns (rows, kept): distinct rows, and the positions in the segment (ascending) of the transitions
        that go there. Whatever is in a row is evicted; a new transition without a row is not kept.
        """

    def prioritise(self, rows: Rows) -> None:
        """Learn that ids or priorities of these rows have changed."""


class Fifo:
    """The oldest transition goes first; transition i lives in row i modulo capacity."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity

    def place(self, first: int, count: int) -> tuple[Rows, slice]:
        """The next rows around the ring; of a segment longer than the table, the end."""
        skipped = max(0, count - self._capacity)
        return np.arange(first + skipped, first + count) % self._capacity, slice(skipped, count)

    def prioritise(self, rows: Rows) -> None:
        """Age alone counts."""


class Reservoir:
    """Every transition ever inserted is held with equal probability (Vitter 1985, algorithm R)."""

    def __init__(self, capacity: int, rng: np.random.Generator) -> None:
        self._capacity = capacity
        self._rng = rng

    def place(self, first: int, count: int) -> tuple[Rows, Rows]:
        """Transition i (from 0) takes row j drawn from 0..i if j < capacity, and is not kept otherwise."""
        rows = np.arange(first, first + count)
        late = max(0, self._capacity - first)  # the first position that finds the table full
        if late < count:
            rows[late:] = self._rng.integers(0, rows[late:] + 1)
        # Of two that take the same row only the later one is there afterwards.
        last = {row: position for position, row in enumerate(rows.tolist()) if row < self._capacity}
        kept = np.fromiter(sorted(last.values()), np.intp, len(last))
        return rows[kept], kept

    def prioritise(self, rows: Rows) -> None:
        """Chance alone counts."""


class LowestPriority:
    """The transition with the lowest priority goes first; among equals, the oldest.

    `ids` int64 [capacity] and `priorities` float64 [capacity] belong to the table, which keeps them up to date.
    The heap may hold outdated entries: an entry counts only while it agrees with these two.
    """

    def __init__(self, ids: NDArray[np.int64], priorities: Floats) -> None:
        self._capacity = len(ids)
        self._ids = ids
        self._priorities = priorities
        self._heap: list[tuple[float, int, int]] = []

    def place(self, first: int, count: int) -> tuple[Rows, slice]:
        """Unused rows, then those of the lowest priorities; new transitions are the last to go."""
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
        """Enter the rows at their new priorities."""
        if len(self._heap) + len(rows) > 2 * self._capacity + 1024:
            live = {entry[2] for entry in self._heap if self._ids[entry[2]] == entry[1]}
            rows = np.fromiter(live | set(rows.tolist()), np.intp)
            self._heap.clear()
        entries = zip(self._priorities[rows].tolist(), self._ids[rows].tolist(), rows.tolist(), strict=True)
        for entry in entries:
            heapq.heappush(self._heap, entry)


class Sampling(Protocol):
    """Draws rows of the table, and says how to weigh them."""

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """Rows intp [count] among 0..size-1, and weights float32 [count] (largest: 1)."""

    def prioritise(self, rows: Rows, priorities: Floats) -> None:
        """Learn the priorities of these rows."""


class Uniform:
    """Every held transition is equally likely; without replacement, none is drawn again before all others are."""

    def __init__(self, rng: np.random.Generator, *, replacement: bool) -> None:
        self._rng = rng
        self._replacement = replacement

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """All weights are 1."""
        if self._replacement:
            rows = self._rng.integers(0, size, count)
        else:
            everything = np.tile(np.arange(size), count // size)
            rows = np.concatenate((everything, self._rng.choice(size, count % size, replace=False)))
        return rows, np.ones(count, np.float32)

    def prioritise(self, rows: Rows, priorities: Floats) -> None:
        """All are equal."""


class Proportional:
    """P(i) = p_i^alpha / sum_k p_k^alpha, weights (size P(i))^-beta over the batch's largest (Schaul et al. 2016).

    One draw from each of `count` equal shares of the sum, as there, so that one transition may be drawn twice. A
    priority below `PRIORITY_FLOOR` counts as that, so that nothing held is out of reach.
    """

    def __init__(self, capacity: int, rng: np.random.Generator, alpha: float, beta: float) -> None:
        self._tree = SumTree(capacity)
        self._rng = rng
        self._alpha = alpha
        self._beta = beta

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """One draw from each share, and its importance-sampling weight."""
        shares = (np.arange(count) + self._rng.random(count)) / count
        rows = self._tree.find(shares * self._tree.total)
        weights = (size * self._tree.values(rows) / self._tree.total) ** -self._beta
        return rows, (weights / weights.max()).astype(np.float32)

    def prioritise(self, rows: Rows, priorities: Floats) -> None:
        """Set p_i^alpha of these rows; where a row repeats, its last priority counts."""
        self._tree.update(rows, np.maximum(priorities, PRIORITY_FLOOR) ** self._alpha)


class SumTree:
    """Sums of non-negative values, sixteen to a node: values are set and found by running sum in O(log n).

    Every node is always the sum of its sixteen, added from left to right, so the tree is a function of its values
    alone, whatever the order of updates: a restored tree equals the saved one to the bit.
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
        """Set values; where a row repeats, the last one counts."""
        self._levels[0].reshape(-1)[rows] = values
        for below, above in pairwise(self._levels):
            rows = rows >> 4
            above.reshape(-1)[rows] = below[rows].cumsum(axis=1)[:, -1]

    def find(self, sums: Floats) -> Rows:
        """For each running sum in [0, total): the row whose value covers it, never one whose value is 0."""
        lines = np.arange(len(sums))
        nodes = np.zeros(len(sums), np.intp)
        for level in reversed(self._levels):
            running = level[nodes].cumsum(axis=1)
            # Rounding on the way may leave a sum at the end of its node, where nothing covers it.
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
    """The eviction policy of this name for a table of len(ids) rows; raises UsageError for any other name."""
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
    """The sampling policy of this name; raises UsageError for any other, or one that can't do without replacement."""
    match name:
        case "uniform":
            return Uniform(rng, replacement=replacement)
        case "prioritized" if not replacement:
            raise UsageError("sampling: 'prioritized' draws with replacement; without, allowed is uniform")
        case "prioritized":
            return Proportional(capacity, rng, alpha, beta)
    raise UsageError(f"sampling: {name!r} is not one of {', '.join(SAMPLINGS)}")
