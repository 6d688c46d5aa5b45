"""The learner's broadcast that ends the run."""

from __future__ import annotations

from typing import ClassVar, Self

from coop.common.bounded import Text
from coop.common.messaging.messages.body import Body

MAX_REASON = 1024  # characters


class EndOfRun(Body, frozen=True):
    """Says that the run is over, and why."""

    kind: ClassVar[str] = "stop"

    reason: Text

    @classmethod
    def because(cls, reason: str) -> Self:
        """Build it with a reason, cut to `MAX_REASON` characters."""
        return cls(reason[:MAX_REASON])
