"""Answers to any request: a receipt, a request to try again later, or an error."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from msgspec import Meta

from coop.common.bounded import Counter, Text
from coop.common.errors import BadMessage, CoopError
from coop.common.messaging.messages.body import Body

LONGEST_PROBLEM = 4096  # characters


class Ack(Body, frozen=True):
    """The receipt for a segment or for a request that succeeded.

    inserted: the table's count of accepted transitions. window: segments that the sender may have in flight from now
    on; 0 for any number.
    """

    kind: ClassVar[str] = "ack"

    inserted: Counter
    window: Counter = 0


class Retry(Body, frozen=True):
    """Asks the sender to send its request again later, and gives the reason."""

    kind: ClassVar[str] = "retry"

    reason: Text


class Error(Body, frozen=True):
    """Answers a message that is invalid (`field` names the invalid field) or whose request failed."""

    kind: ClassVar[str] = "error"

    field: Text
    problem: Annotated[str, Meta(max_length=LONGEST_PROBLEM)]

    @classmethod
    def of(cls, error: Exception) -> Self:
        """The answer to a message that caused `error`."""
        field = error.field if isinstance(error, BadMessage) else ""
        problem = str(error) if isinstance(error, CoopError) else f"error of this program: {error!r}"
        return cls(field[:1024], problem[:LONGEST_PROBLEM])
