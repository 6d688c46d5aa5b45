"""What a role tells displays of itself: plain values by name, of which a display takes what it knows."""

from __future__ import annotations

from typing import Annotated, Any, Self

import msgspec
from msgspec import Meta

from common.bounded import Counter, Name, Real, Share, Text
from common.messaging import wire
from common.messaging.messages.body import bad_field, check_kind
from common.messaging.messages.weights import Network
from common.messaging.wire import Message

KIND = "status"


def encode_status(run: str, status: dict[str, Any]) -> bytearray:
    """Build a status."""
    return wire.encode(KIND, run, status)


class LearnerStatus(msgspec.Struct, frozen=True):
    """What a display needs of the learner's status.

    connected: processes by role. missing: those that are lost. events: the newest lines of its console, each with a
    number that grows. origin: where it runs.
    """

    env_steps: Counter
    total_steps: Counter
    updates: Counter
    updates_per_s: Real
    acting: Network
    episodes: Counter
    return_mean_100: Real
    epsilon: Share
    s: Real
    waiting: Text
    connected: dict[Name, Counter]
    warning: Text
    missing: Annotated[list[Text], Meta(max_length=1024)]
    events: Annotated[list[tuple[int, Text]], Meta(max_length=64)]
    origin: Text

    @classmethod
    def decode(cls, message: Message) -> Self:
        """Read it, whatever else is told; raises BadMessage."""
        check_kind(message, KIND)
        try:
            return msgspec.convert(message.fields, cls, strict=True)
        except msgspec.ValidationError as error:
            raise bad_field(error, message.fields) from error
