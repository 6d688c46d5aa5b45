"""The sums of priorities behind proportional sampling, by numpy, or by loops that numba compiles (extra `fast`)."""

from __future__ import annotations

import numpy as np

from coop.replay.table.policies import Floats, Rows

GROUP_BITS = 6
GROUP = 1 << GROUP_BITS
TOP = 2048  # nodes, whose running sums take less time than another level


def make_sum_tree(capacity: int) -> SumTree:
    """A tree of `capacity` zeros, the faster one that this installation has; both give the same bits."""
    try:
        from coop.replay.table.compiled_tree import CompiledSumTree  # noqa: PLC0415 (numba takes a second)
    except ImportError:  # numba is not there, or does not fit the other packages
        return SumTree(capacity)
    return CompiledSumTree(capacity)


class SumTree:
    """Sums of non-negative values, `GROUP` to a node: values are set and found by running sum in O(log n).

    Every node is always the sum of its group, added from left to right, so the tree depends only on its values, not
    on the order of updates: a restored tree equals the saved one to the bit. The running sums of each group
    are kept, so that a search only compares. The lowest level of at most `TOP` nodes is the last, one group.

    Attributes:
        levels: float64 [groups, GROUP] each, from the values up; the last one is [1, nodes].
        running: of each level, float64 [groups, GROUP + 1]: 0, and the sums of a group's first.
    """

    def __init__(self, capacity: int) -> None:
        shapes, nodes = [], capacity
        while nodes > TOP:
            nodes = -(-nodes // GROUP)
            shapes.append((nodes, GROUP))
        shapes.append((1, nodes))
        self.levels: tuple[Floats, ...] = tuple(np.zeros(shape) for shape in shapes)
        self.running: tuple[Floats, ...] = tuple(np.zeros((groups, size + 1)) for groups, size in shapes)

    @property
    def total(self) -> float:
        """Sum of all values."""
        return float(self.running[-1][0, -1])

    def values(self, rows: Rows) -> Floats:
        """Values at these rows."""
        found: Floats = self.levels[0].ravel()[rows]
        return found

    def draw(self, places: Floats) -> tuple[Rows, Floats]:
        """A row from each of n equal shares of the sum, at its place in [0, 1) there, and the values of these rows."""
        rows = self.find((np.arange(len(places)) + places) / len(places) * self.total)
        return rows, self.values(rows)

    def update(self, rows: Rows, values: Floats) -> None:
        """Set values; if a row repeats, its last value counts."""
        self.levels[0].ravel()[rows] = values
        for below, running, above in zip(self.levels, self.running, self.levels[1:], strict=False):
            rows = rows >> GROUP_BITS
            sums = below.take(rows, axis=0).cumsum(axis=1)
            running[rows, 1:] = sums
            above.ravel()[rows] = sums[:, -1]
        self.levels[-1].cumsum(out=self.running[-1][0, 1:])

    def find(self, sums: Floats) -> Rows:
        """For each running sum in [0, total), the row whose value covers it; never a row whose value is 0."""
        lines = np.arange(len(sums))
        top = self.running[-1][0]
        # Rounding may move a sum to the end of its node, which no value covers.
        sums = np.minimum(sums, np.nextafter(top[-1], 0))
        nodes: Rows = top.searchsorted(sums, "right") - 1
        before = top[nodes]
        for running in self.running[-2::-1]:
            inside = running.take(nodes, axis=0)
            sums = np.minimum(sums - before, np.nextafter(inside[:, -1], 0))
            child = (inside > sums[:, None]).argmax(axis=1) - 1
            before = inside[lines, child]
            nodes = nodes * GROUP + child
        return nodes
