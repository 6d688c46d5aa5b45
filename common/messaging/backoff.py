"""What clients of the replay service have in common: they ask until they are answered, and say why they wait."""

from __future__ import annotations

from coop.common.process.lifecycle import Stop

NO_ANSWER = "the replay service does not answer"
BAD_ANSWER = "the replay service's answer is bad"


class Backoff:
    """Pauses that double from `first` up to `longest` seconds, until `reset`."""

    def __init__(self, first: float = 0.02, longest: float = 1.0) -> None:
        self._first = self._next = first
        self._longest = longest

    def pause(self, stop: Stop) -> bool:
        """Sleep; return True if a stop was requested."""
        pause, self._next = self._next, min(self._longest, 2 * self._next)
        return stop.wait(pause)

    def reset(self) -> None:
        """Return to the shortest pause."""
        self._next = self._first
