"""The checkpoints that learner and replay service both hold; a resumed run continues from the newest."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from coop.common.errors import UsageError
from coop.common.messaging.messages.control import Join
from coop.common.process.lifecycle import Stop

LOOK_EVERY = 0.1  # seconds
REFUSAL = 0.5  # seconds for the refusal to reach the replay service before this process ends


class SharedCheckpoints:
    """Determines the checkpoint from which a run continues.

    This is decided once: when the replay service has announced its checkpoints, or at once if the learner has none.

    Args:
        held: numbers of the learner's intact checkpoints.
        run: the run directory, for the message of a refusal.
        restart: start from the beginning if no checkpoint is held by both.

    Attributes:
        newest: number of the newest shared checkpoint; 0 if there is none, or before the decision.
    """

    def __init__(self, held: Sequence[int], run: str, *, restart: bool = False) -> None:
        self.newest = 0
        self._held = held
        self._run = run
        self._restart = restart
        self._problem = ""
        self._began_anew = -1  # incarnation of the replay service that was told to start from the beginning
        self._decided = threading.Event()
        if not held:
            self._decided.set()

    def offered(self, request: Join) -> tuple[int, bool]:
        """Answer a joining replay service: the checkpoint to restore, and whether to start from the beginning.

        Raises:
            UsageError: no checkpoint is held by both.
        """
        if not self._decided.is_set():
            self._decide(request)
            self._decided.set()
        if self._problem:
            raise UsageError(self._problem)
        return self.newest, request.incarnation == self._began_anew

    def finished(self, number: int) -> None:
        """Note a newly finished checkpoint."""
        self.newest = number

    def wait(self, stop: Stop) -> int | None:
        """Wait for the decision: the checkpoint to continue from, 0 for the beginning, None if a stop comes first.

        Raises:
            UsageError: no checkpoint is held by both.
        """
        while not self._decided.wait(LOOK_EVERY):
            if stop.is_set():
                return None
        if self._problem:
            stop.wait(REFUSAL)
            raise UsageError(self._problem)
        return self.newest

    def _decide(self, request: Join) -> None:
        # A service that is already serving has its table in memory; a table ahead of the learner does no harm.
        both = set(self._held) if request.serving else set(self._held) & set(request.checkpoints)
        if both:
            self.newest = max(both)
        elif self._restart:
            self._began_anew = request.incarnation
        else:
            self._problem = (
                f"no checkpoint to resume from: {self._run} {_listed(self._held)}, the replay service on "
                f"{request.origin} {_listed(request.checkpoints)}; nothing was changed. With --restart the training "
                "starts over, and what there is is moved aside"
            )


def _listed(checkpoints: Sequence[int]) -> str:
    return f"holds checkpoints {', '.join(map(str, checkpoints))}" if checkpoints else "holds none"
