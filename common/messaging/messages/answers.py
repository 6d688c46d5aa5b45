"""What any question may be answered with: a receipt, "not now", or what is wrong with it."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from msgspec import Meta

from common.bounded import Counter, Text
from common.errors import BadMessage, CoopError
from common.messaging.messages.body import Body

LONGEST_PROBLEM = 4096  # characters


class Ack(Body, frozen=True):
    """The receipt of a segment, or of a request that was carried out.

    inserted: the table's count of accepted transitions.
    """

    kind: ClassVar[str] = "ack"

    inserted: Counter


class Retry(Body, frozen=True):
    """Not now, and why: the request is to be sent again."""

    kind: ClassVar[str] = "retry"

    reason: Text


class Error(Body, frozen=True):
    """The answer to a message that is bad (`field` names what is), or that could not be carried out."""

    kind: ClassVar[str] = "error"

    field: Text
    problem: Annotated[str, Meta(max_length=LONGEST_PROBLEM)]

    @classmethod
    def of(cls, error: Exception) -> Self:
        """What to answer where a message led to `error`."""
        field = error.field if isinstance(error, BadMessage) else ""
        problem = str(error) if isinstance(error, CoopError) else f"error of this program: {error!r}"
        return cls(field[:1024], problem[:LONGEST_PROBLEM])
