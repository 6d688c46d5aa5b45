"""Curves of bounded length, for as many points as there will be."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

Point = list[float | None]
PointT = TypeVar("PointT", bound=list[Any])


class Thinned(Generic[PointT]):
    """Keeps at most `most` points: at first each that is added, then every second one, and so on.

    points: the oldest first; each begins with its place on the x axis.
    """

    def __init__(self, most: int) -> None:
        self.points: list[PointT] = []
        self._most = most
        self.clear()

    def clear(self) -> None:
        """Forget all points."""
        self.points, self._every, self._seen = [], 1, 0

    def add(self, point: PointT) -> None:
        """Note a point; a place that goes back, after a resumption from a checkpoint, begins the curve anew."""
        if self.points and point[0] < self.points[-1][0]:
            self.clear()
        if self._seen % self._every == 0:
            self.points.append(point)
        self._seen += 1
        if len(self.points) > self._most:
            self.points = self.points[::2]
            self._every *= 2
