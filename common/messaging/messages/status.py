"""The status of a role, for displays: plain values by name, of which a display uses those that it knows."""

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
    """The part of the learner's status that displays need.

    connected: number of processes by role, of the replay services only the one that serves. missing: lost processes.
    events: the newest lines of its console, with increasing numbers. origin: its host and process id.
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
        """Read it, ignoring other fields; raises BadMessage."""
        check_kind(message, KIND)
        try:
            return msgspec.convert(message.fields, cls, strict=True)
        except msgspec.ValidationError as error:
            raise bad_field(error, message.fields) from error
