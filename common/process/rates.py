"""The speed of a growing count; time is an argument."""

from __future__ import annotations

from collections import deque


class Rate:
    """The growth per second of a count over the last seconds.

    Args:
        window: seconds to look back.
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._points: deque[tuple[float, int]] = deque()

    def at(self, now: float, count: int) -> float:
        """Note the count; return its rate, 0 at the first call."""
        if self._points and now <= self._points[-1][0]:
            self._points.pop()
        self._points.append((now, count))
        while len(self._points) > 2 and self._points[1][0] <= now - self._window:
            self._points.popleft()
        then, before = self._points[0]
        return max(0.0, (count - before) / (now - then)) if now > then else 0.0
