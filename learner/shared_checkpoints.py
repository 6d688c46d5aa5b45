"""The checkpoints that learner and replay service both hold; a resumed run continues from the newest."""

from __future__ import annotations

from collections.abc import Sequence

from coop.common.errors import UsageError
from coop.common.messaging.conversation import Conversation
from coop.common.messaging.messages.control import Join
from coop.common.messaging.timing import LOOK_EVERY, REFUSAL


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
        self._decided = not held

    def offered(self, request: Join) -> tuple[int, bool]:
        """Answer a joining replay service: the checkpoint to restore, and whether to start from the beginning.

        Raises:
            UsageError: no checkpoint is held by both.
        """
        if not self._decided:
            self._decide(request)
            self._decided = True
        if self._problem:
            raise UsageError(self._problem)
        return self.newest, request.incarnation == self._began_anew

    def finished(self, number: int) -> None:
        """Note a newly finished checkpoint."""
        self.newest = number

    def decided(self) -> Conversation[int | None]:
        """Wait for the decision: the checkpoint to continue from, 0 for the beginning, None if a stop comes first.

        Raises:
            UsageError: no checkpoint is held by both.
        """
        while not self._decided:
            if (yield LOOK_EVERY):
                return None
        if self._problem:
            yield REFUSAL
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
