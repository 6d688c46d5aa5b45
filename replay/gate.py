"""The gate at which requests of one kind wait for the limiter; time is an argument."""

from __future__ import annotations

from coop.common.messaging.messages.status import Held
from coop.common.messaging.timing import ASKED_AGAIN, HOLD


class Gate:
    """Notes since when it has been closed, and for how long requests have waited.

    A request is held until `HOLD` seconds after the gate closed, so that the waits of queued requests do not add up.
    """

    def __init__(self, now: float) -> None:
        self._closed_at: float | None = None
        self._asked_at = now
        self._reason = ""
        self._waited = 0.0  # seconds since `_reported_at`, without those since the gate last closed
        self._reported_at = now

    def refuse(self, reason: str, now: float) -> float:
        """Note that a request is not admitted; return the seconds for which it may still be held."""
        if self._closed_at is None:
            self._closed_at = now
        self._asked_at, self._reason = now, reason
        return self._closed_at + HOLD - now

    def admit(self, now: float) -> None:
        """Note that a request is admitted."""
        self._waited += self._waiting(now)
        self._closed_at = None

    def held(self, now: float) -> Held:
        """How requests have been held up since the last call."""
        seconds, elapsed = self._waited + self._waiting(now), now - self._reported_at
        self._waited, self._reported_at = 0.0, now
        share = min(1.0, seconds / elapsed) if elapsed > 0 else 0.0
        return Held(share, self._reason if share else "")

    def _waiting(self, now: float) -> float:
        """Seconds since the gate closed, or since the last report, in which someone was waiting."""
        if self._closed_at is None:
            return 0.0
        return max(0.0, min(now, self._asked_at + ASKED_AGAIN) - max(self._closed_at, self._reported_at))
