"""The epochs that learner and replay service both hold; a resumed run goes on from the newest of them."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from common.errors import RunError
from common.messaging.messages.join import Join
from common.process.lifecycle import Stop

LOOK_EVERY = 0.1  # seconds
REFUSAL = 0.5  # seconds that the refusal gets to reach the replay service before this process leaves


class SharedEpochs:
    """Which epochs a run can go on from.

    Where it goes on is decided once: when the replay service has told what it holds, at once where the learner holds
    none.

    Args:
        held: numbers of the learner's whole epochs.
        run: the run directory, for the words of a refusal.
        restart: begin anew where no epoch is held by both.

    Attributes:
        newest: number of the newest one; 0 if there is none, or while it is not decided.
    """

    def __init__(self, held: Sequence[int], run: str, *, restart: bool = False) -> None:
        self.newest = 0
        self._held = held
        self._run = run
        self._restart = restart
        self._problem = ""
        self._began_anew = -1  # incarnation of the replay service that was told to
        self._decided = threading.Event()
        if not held:
            self._decided.set()

    def offered(self, request: Join) -> tuple[int, bool]:
        """Answer a replay service that joins: the epoch to restore, and whether to begin anew.

        Raises:
            RunError: no epoch is held by both.
        """
        if not self._decided.is_set():
            self._decide(request)
            self._decided.set()
        if self._problem:
            raise RunError(self._problem)
        return self.newest, request.incarnation == self._began_anew

    def finished(self, number: int) -> None:
        """Note a new one."""
        self.newest = number

    def wait(self, stop: Stop) -> int | None:
        """Wait until it is decided; the epoch to go on from, 0 for a beginning, None where the stop came first.

        Raises:
            RunError: no epoch is held by both.
        """
        while not self._decided.wait(LOOK_EVERY):
            if stop.is_set():
                return None
        if self._problem:
            stop.wait(REFUSAL)
            raise RunError(self._problem)
        return self.newest

    def _decide(self, request: Join) -> None:
        # Who serves already has the table in memory, and a table that is ahead of the learner does no harm.
        both = set(self._held) if request.serving else set(self._held) & set(request.epochs)
        if both:
            self.newest = max(both)
        elif self._restart:
            self._began_anew = request.incarnation
        else:
            self._problem = (
                f"no epoch to go on from: {self._run} {_listed(self._held)}, the replay service on "
                f"{request.origin} {_listed(request.epochs)}; with --restart the training begins anew"
            )


def _listed(epochs: Sequence[int]) -> str:
    return f"holds epochs {', '.join(map(str, epochs))}" if epochs else "holds none"
