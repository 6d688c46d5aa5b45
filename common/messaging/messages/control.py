"""What directs a run: joining and leaving, checkpoints, the limiter's settings, and the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Self

import msgspec
from msgspec import Meta

from coop.common.bounded import Count, Counter, Incarnation, Name, Real, Text, Updates
from coop.common.bounds import MAX_COUNT, MAX_RATIO, MAX_TOLERANCE
from coop.common.errors import BadMessage, UsageError
from coop.common.imports import check_permitted
from coop.common.messaging import wire
from coop.common.messaging.members import JOINING, Origin
from coop.common.messaging.messages.body import Body
from coop.common.messaging.wire import Message
from coop.common.settings.config import OF_REGISTRIES, RunConfig
from coop.common.settings.overrides import leaves
from coop.common.settings.tables import to_tables, validated
from coop.common.types import EnvSpec

Endpoints = Annotated[list[Name], Meta(max_length=16)]
MOST_CHECKPOINTS = 16  # checkpoints in one request
Checkpoints = Annotated[list[Updates], Meta(max_length=MOST_CHECKPOINTS)]


class Join(Body, frozen=True):
    """A process asks to be part of the run.

    endpoints: where others can reach it; empty for actors, and if a replay service only asks which run this is.
    index: the index from an earlier join, or -1. checkpoints: those that a replay service can restore, in ascending
    order. serving: its table is in memory already and can continue from any checkpoint of the learner's.
    origin: its host and process id.
    """

    kind: ClassVar[str] = "join"

    role: Annotated[str, Meta(pattern=f"^({'|'.join(JOINING)})$")]
    incarnation: Incarnation
    endpoints: Endpoints
    index: Annotated[int, Meta(ge=-1, le=MAX_COUNT)] = -1
    checkpoints: Checkpoints = msgspec.field(default_factory=list)
    serving: bool = False
    origin: Origin = msgspec.field(default_factory=Origin.here)


class JoinReply(Body, frozen=True):
    """All that a role needs to take part.

    replay_endpoints: where the replay service listens; empty while none has joined.
    index: number of processes of this role that joined the run before (makes actors' random streams distinct).
    layout: digest of the network layout, which the role compares with its own.
    run_id: random id from the run's beginning, which distinguishes it from other runs of the same name.
    checkpoint: number of the newest finished checkpoint, which a replay service restores; 0 if there is none.
    anew: the training starts again from the beginning, so a replay service discards its data of the run.
    learner, replay: their hosts and process ids; `replay` is None while no replay service has joined.
    """

    kind: ClassVar[str] = "join-reply"

    config: RunConfig
    spec: EnvSpec
    layout: Annotated[str, Meta(max_length=64)]
    index: Count
    replay_endpoints: Endpoints
    run_id: Incarnation
    checkpoint: Updates
    anew: bool = False
    learner: Origin = msgspec.field(default_factory=Origin.here)
    replay: Origin | None = None

    def encode(self, run: str) -> bytearray:
        """Build the message."""
        return self.answer(run, to_tables(self.config))

    def answer(self, run: str, tables: Mapping[str, Any]) -> bytearray:
        """Build the message with the config's tables, which take longer to make than all the rest."""
        return wire.encode(self.kind, run, {**msgspec.structs.asdict(self), "config": tables})

    @classmethod
    def decode(cls, message: Message) -> Self:
        """Read it; raises BadMessage, and JoinError if it needs a module that this process may not import."""
        tables: Any = message.fields.get("config")
        if tables is None:  # missing
            return super().decode(message)
        if not isinstance(tables, dict):
            raise BadMessage("fields.config", "not a table")
        for name, path in _modules(tables):
            check_permitted(path, name)
        try:
            config = validated(tables)
        except UsageError as error:
            raise BadMessage("fields.config", str(error)) from error
        fields = {**message.fields, "config": config}
        return super().decode(Message(message.kind, message.run, fields, message.arrays, message.table))


def _modules(tables: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """The settings of a config that reading it imports as "module:name", with their values."""
    for path, value in leaves(tables):
        if isinstance(value, str) and ":" in value and ".".join(path) in OF_REGISTRIES:
            yield ".".join(path), value


class Leave(Body, frozen=True):
    """Announces that a process stops; the answer is a farewell, or a retry while the learner needs it."""

    kind: ClassVar[str] = "leave"

    incarnation: Incarnation


class Farewell(Body, frozen=True):
    """The learner's permission to leave."""

    kind: ClassVar[str] = "farewell"


class Snapshot(Body, frozen=True):
    """Begins the part of checkpoint `number`; of the older checkpoints, only `keep` is kept.

    learner: incarnation of the one that asks. asked: how many checkpoints it has asked for before; a late copy of an
    earlier request begins nothing.
    """

    kind: ClassVar[str] = "snapshot"

    number: Updates
    keep: Checkpoints
    learner: Incarnation
    asked: Counter


class Written(Body, frozen=True):
    """Asks whether the part of checkpoint `number` is on disk."""

    kind: ClassVar[str] = "written"

    number: Updates


class LimitsQuestion(Body, frozen=True):
    """Asks for the settings."""

    kind: ClassVar[str] = "limits"


class Limit(Body, frozen=True):
    """New settings; answered like the question.

    ratio: updates per environment step. tolerance: environment steps by which acting and learning may differ.
    """

    kind: ClassVar[str] = "limit"

    ratio: Annotated[float, Meta(gt=0, le=MAX_RATIO)]
    tolerance: Annotated[float, Meta(ge=0, le=MAX_TOLERANCE)]


class Limits(Body, frozen=True):
    """The state of a running replay service's limiter.

    ratio, tolerance: see `Limit`. inserted: transitions so far.
    drawn: batches so far, out of `planned` in the complete run.
    inserts_wait_for, samples_wait_for: why they wait, in words; empty if they do not.
    """

    kind: ClassVar[str] = "limits"

    ratio: Real
    tolerance: Real
    inserted: Counter
    drawn: Counter
    planned: Counter
    inserts_wait_for: Text
    samples_wait_for: Text


MAX_REASON = 1024  # characters


class EndOfRun(Body, frozen=True):
    """Says that the run is over, and why."""

    kind: ClassVar[str] = "stop"

    reason: Text

    @classmethod
    def because(cls, reason: str) -> Self:
        """Build it with a reason, cut to `MAX_REASON` characters."""
        return cls(reason[:MAX_REASON])
