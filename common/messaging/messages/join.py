"""Joining: a role asks the learner for the run, and takes leave of it when it was told to stop."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Self

import msgspec
from msgspec import Meta

from common.bounded import Count, Incarnation, Name, Updates
from common.bounds import MAX_COUNT
from common.errors import BadMessage, UsageError
from common.messaging import wire
from common.messaging.messages.body import Body
from common.messaging.presence import JOINING, Origin
from common.messaging.wire import Message
from common.settings.config import RunConfig
from common.settings.tables import to_tables, validated
from common.types import EnvSpec

Endpoints = Annotated[list[Name], Meta(max_length=16)]
MOST_EPOCHS = 16  # that are told of at once
Epochs = Annotated[list[Updates], Meta(max_length=MOST_EPOCHS)]


class Join(Body, frozen=True):
    """A process asks to be part of the run.

    endpoints: where others can reach it; none for actors, and none where a replay service only asks which run this is.
    index: the one it was given when it joined before, or -1. epochs: those that a replay service can restore, in
    ascending order. serving: it holds its table in memory already, and goes on from any epoch of the learner's.
    origin: where it runs.
    """

    kind: ClassVar[str] = "join"

    role: Annotated[str, Meta(pattern=f"^({'|'.join(JOINING)})$")]
    incarnation: Incarnation
    endpoints: Endpoints
    index: Annotated[int, Meta(ge=-1, le=MAX_COUNT)] = -1
    epochs: Epochs = msgspec.field(default_factory=list)
    serving: bool = False
    origin: Origin = msgspec.field(default_factory=Origin.here)


class Joined(Body, frozen=True):
    """All that a role needs.

    replay_endpoints: where the replay service listens; empty while none has joined.
    index: how many processes of this role had joined the run before (tells actors' random streams apart).
    layout: digest of the network layout, to be compared with one's own.
    run_id: drawn at random when the run began; tells it from others of its name.
    epoch: number of the newest epoch that is finished, which a replay service restores; 0 if there is none.
    anew: the training begins anew: a replay service drops what it holds of it.
    learner, replay: where they run; None while no replay service has joined.
    """

    kind: ClassVar[str] = "joined"

    config: RunConfig
    spec: EnvSpec
    layout: Annotated[str, Meta(max_length=64)]
    index: Count
    replay_endpoints: Endpoints
    run_id: Incarnation
    epoch: Updates
    anew: bool = False
    learner: Origin = msgspec.field(default_factory=Origin.here)
    replay: Origin | None = None

    def answer(self) -> bytearray:
        """Build the message; the config knows its run."""
        return self.encode(self.config.run)

    def encode(self, run: str) -> bytearray:
        """Build the message."""
        return wire.encode(self.kind, run, {**msgspec.structs.asdict(self), "config": to_tables(self.config)})

    @classmethod
    def decode(cls, message: Message) -> Self:
        """Read it; raises BadMessage."""
        tables: Any = message.fields.get("config")
        if tables is None:  # missing
            return super().decode(message)
        if not isinstance(tables, dict):
            raise BadMessage("fields.config", "not a table")
        try:
            config = validated(tables)
        except UsageError as error:
            raise BadMessage("fields.config", str(error)) from error
        fields = {**message.fields, "config": config}
        return super().decode(Message(message.kind, message.run, fields, message.arrays))


class Leave(Body, frozen=True):
    """The notice of a process that was told to stop; the answer is a farewell, or a retry while it is needed."""

    kind: ClassVar[str] = "leave"

    incarnation: Incarnation


class Farewell(Body, frozen=True):
    """The learner's answer to a process that may leave."""

    kind: ClassVar[str] = "farewell"
