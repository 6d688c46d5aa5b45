"""When to restart a killed process: after growing pauses, a limited number of times. Time is an argument."""

from __future__ import annotations

from dataclasses import dataclass, field

FIRST_PAUSE = 0.25  # seconds
LONGEST_PAUSE = 4.0  # seconds
HEALTHY = 60.0  # seconds without an end after which the count starts again
RESTARTS = 20  # without a healthy period between them


@dataclass(slots=True)
class RestartPolicy:
    """Decides when to restart one process.

    ends: number of ends since its last healthy period. at: when to restart it, in seconds; None while it runs.
    """

    ends: int = 0
    at: float | None = field(default=None)
    _last: float = -HEALTHY

    def ended(self, now: float) -> bool:
        """Note an end; return False if it has ended too often."""
        if now - self._last >= HEALTHY:
            self.ends = 0
        self._last = now
        self.ends += 1
        self.at = now + min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** (self.ends - 1))
        return self.ends <= RESTARTS

    def due(self, now: float) -> bool:
        """Return True once, when the pause is over."""
        if self.at is None or now < self.at:
            return False
        self.at = None
        return True
