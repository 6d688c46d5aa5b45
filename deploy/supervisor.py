"""When a killed process is started again: after growing pauses, not for ever. Plain: time comes in as an argument."""

from __future__ import annotations

from dataclasses import dataclass, field

FIRST_PAUSE = 0.25  # seconds
LONGEST_PAUSE = 4.0  # seconds
HEALTHY = 60.0  # seconds without an end after which the past is forgotten
RESTARTS = 20  # without a healthy spell between them


@dataclass(slots=True)
class RestartPolicy:
    """When one process may be started again.

    ends: how often it ended since its last healthy spell. at: when to start it again, None while it runs.
    """

    ends: int = 0
    at: float | None = field(default=None)
    _last: float = -HEALTHY

    def ended(self, now: float) -> bool:
        """Note an end; False if it has ended too often."""
        if now - self._last >= HEALTHY:
            self.ends = 0
        self._last = now
        self.ends += 1
        self.at = now + min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** (self.ends - 1))
        return self.ends <= RESTARTS

    def due(self, now: float) -> bool:
        """True once when the pause is over."""
        if self.at is None or now < self.at:
            return False
        self.at = None
        return True
