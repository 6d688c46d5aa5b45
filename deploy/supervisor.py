"""What to do about a process that has ended before its run: start it again after growing pauses, or give up."""

from __future__ import annotations

from dataclasses import dataclass, field

FIRST_PAUSE = 0.25  # seconds
LONGEST_PAUSE = 4.0  # seconds
HEALTHY = 60.0  # seconds without an end after which the count starts again
RESTARTS = 20  # without a healthy period between them
MEMORY_RESTARTS = 2  # in all: a table that has outgrown the memory once will do so again


@dataclass(slots=True)
class RestartPolicy:
    """Decides when to restart one process; time is an argument.

    ends: number of ends since its last healthy period. at: when to restart it, in seconds; None while it runs.
    """

    ends: int = 0
    at: float | None = field(default=None)
    _last: float = -HEALTHY
    _words: str = ""
    _memory_kills: int = 0

    def ended(self, now: float, words: str = "", *, for_memory: bool = False) -> str:
        """Note an end; return why another start would be in vain, in words; empty if it would not.

        words: with which it ended by itself; what has come twice within `HEALTHY` seconds will come again.
        for_memory: the system has killed it because the memory was used up.
        """
        soon = now - self._last < HEALTHY
        again, self._words = soon and bool(words) and words == self._words, words
        self.ends = self.ends + 1 if soon else 1
        self._last = now
        self._memory_kills += for_memory
        self.at = now + min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** (self.ends - 1))
        if again:
            return "it has ended like this twice in a row"
        if self._memory_kills > MEMORY_RESTARTS:
            return f"it has been started again {MEMORY_RESTARTS} times"
        return f"it has been started again {RESTARTS} times" if self.ends > RESTARTS else ""

    def due(self, now: float) -> bool:
        """Return True once, when the pause is over."""
        if self.at is None or now < self.at:
            return False
        self.at = None
        return True
