"""Messages that steer a run: their schemas, how they are built and how they are read back.

join / joined        a role asks the learner for the run
leave / farewell     a role that was told to stop takes leave of the learner
insert / ack         a segment for the table, and its receipt
sample / batch       the learner draws; also carries the episodes that ended
retry                the limiter's answer to an insert or a sample, with the reason in words
weights, role, stop  the learner's broadcasts
status               what a role is doing, for displays
stats                a question to the replay service
snapshot, written    have the replay service begin its part of an epoch; ask whether it is on disk
error                the answer to a message that is bad (names the field) or that could not be carried out
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from dataclasses import fields as dataclass_fields
from typing import Any

from common.bounds import MAX_ENV_ID, MAX_STACK
from common.errors import BadMessage, CoopError, UsageError
from common.messaging import wire
from common.messaging.presence import ROLES, Origin
from common.messaging.schema import Flag, Int, ListOf, Optional, Row, Rule, Schema, Table, Text
from common.messaging.wire import Message
from common.settings.config import RunConfig
from common.settings.tables import to_tables, validated
from common.types import Array, EnvSpec

INCARNATION = Int(0, 2**63 - 1)
_ENDPOINTS = ListOf(Text(256), 16)


@dataclass(frozen=True, slots=True)
class Join:
    """A process asks to be part of the run.

    endpoints: where others can reach it; none for actors, and none where a replay service only asks which run this is.
    index: the one it was given when it joined before, or -1. epochs: those that a replay service can restore, in
    ascending order. serving: it holds its table in memory already, and goes on from any epoch of the learner's.
    origin: where it runs.
    """

    role: str
    incarnation: int
    endpoints: list[str]
    index: int = -1
    epochs: list[int] = field(default_factory=list)
    serving: bool = False
    origin: Origin = field(default_factory=Origin.here)


@dataclass(frozen=True, slots=True)
class Joined:
    """All that a role needs.

    replay_endpoints: where the replay service listens; empty while none has joined.
    index: how many processes of this role had joined the run before (tells actors' random streams apart).
    layout: digest of the network layout, to be compared with one's own.
    run_id: drawn at random when the run began; tells it from others of its name.
    epoch: number of the newest epoch that is finished, which a replay service restores; 0 if there is none.
    anew: the training begins anew: a replay service drops what it holds of it.
    learner, replay: where they run; None while no replay service has joined.
    """

    config: RunConfig
    spec: EnvSpec
    layout: str
    index: int
    replay_endpoints: list[str]
    run_id: int
    epoch: int
    anew: bool = False
    learner: Origin = field(default_factory=Origin.here)
    replay: Origin | None = None


@dataclass(frozen=True, slots=True)
class Role:
    """Who acts: the network (1 or 2), the newest version of each network, and how far the run is."""

    acting: int
    versions: tuple[int, int]
    updates: int


@dataclass(frozen=True, slots=True)
class ReplayStats:
    """The replay service's counters, in transitions unless named otherwise.

    drawn: batches. lost: acknowledged to an actor and not here. duplicates: segments delivered again and refused.
    """

    size: int
    inserted: int
    drawn: int
    evicted: int
    evicted_unsampled: int
    duplicates: int
    lost: int
    episodes: int
    bad_messages: int
    inserts_wait_for: str
    samples_wait_for: str


_EPOCHS = ListOf(Int(), 16)
_ORIGIN = Row((Text(256), Int(0, 2**31)))
_JOIN = Schema(
    "join",
    {
        "role": Text(16),
        "incarnation": INCARNATION,
        "endpoints": _ENDPOINTS,
        "index": Int(-1),
        "epochs": _EPOCHS,
        "serving": Flag(),
        "origin": _ORIGIN,
    },
    {},
)
_JOINED = Schema(
    "joined",
    {
        "config": Table(),
        "spec": Table(),
        "layout": Text(64),
        "index": Int(),
        "replay_endpoints": _ENDPOINTS,
        "run_id": INCARNATION,
        "epoch": Int(),
        "anew": Flag(),
        "learner": _ORIGIN,
        "replay": Optional(_ORIGIN),
    },
    {},
)
_LEAVE = Schema("leave", {"incarnation": INCARNATION}, {})
_ACK = Schema("ack", {"inserted": Int()}, {})
_RETRY = Schema("retry", {"reason": Text()}, {})
_ERROR = Schema("error", {"field": Text(), "problem": Text(4096)}, {})
_ROLE = Schema("role", {"acting": Int(1, 2), "versions": Row((Int(), Int())), "updates": Int()}, {})
_STATS = Schema(
    "stats",
    {field.name: Text() if field.name.endswith("_wait_for") else Int() for field in dataclass_fields(ReplayStats)},
    {},
)
_SNAPSHOT = Schema("snapshot", {"number": Int(), "keep": _EPOCHS}, {})
_WRITTEN = Schema("written", {"number": Int()}, {})
_STOP = Schema("stop", {"reason": Text()}, {})


def encode_join(run: str, join: Join) -> bytearray:
    """Build a join request."""
    return wire.encode("join", run, asdict(join))


def decode_join(message: Message) -> Join:
    """Read a join request; raises BadMessage."""
    _JOIN.check(message)
    join = Join(**{**message.fields, "origin": Origin(*message.fields["origin"])})
    if join.role not in ROLES:
        raise BadMessage("fields.role", f"{join.role!r}; one of {', '.join(ROLES)}")
    return join


def encode_joined(joined: Joined) -> bytearray:
    """Build the learner's answer."""
    fields = {field.name: getattr(joined, field.name) for field in dataclass_fields(Joined)}
    tables = {"config": to_tables(joined.config), "spec": asdict(joined.spec)}
    return wire.encode("joined", joined.config.run, {**fields, **tables})


def decode_joined(message: Message) -> Joined:
    """Read the learner's answer; raises BadMessage."""
    _JOINED.check(message)
    fields = message.fields
    try:
        config = validated(fields["config"])
    except UsageError as error:
        raise BadMessage("fields.config", str(error)) from error
    learner, replay = (origin and Origin(*origin) for origin in (fields["learner"], fields["replay"]))
    return Joined(**{**fields, "config": config, "spec": _spec(fields["spec"]), "learner": learner, "replay": replay})


def encode_leave(run: str, incarnation: int) -> bytearray:
    """Build the notice of a process that was told to stop; the answer is a farewell, or a retry while it is needed."""
    return wire.encode("leave", run, {"incarnation": incarnation})


def decode_leave(message: Message) -> int:
    """Read the incarnation of the process that leaves; raises BadMessage."""
    _LEAVE.check(message)
    return int(message.fields["incarnation"])


def _spec(table: dict[str, Any]) -> EnvSpec:
    shape = table.get("frame_shape")
    rules: dict[str, Rule] = {
        "env_id": Text(MAX_ENV_ID),
        "frame_dtype": Text(16),
        "stack": Int(1, MAX_STACK),
        "num_actions": Int(1, 100_000),
    }
    if table.keys() != {*rules, "frame_shape"} or ListOf(Int(1, 65_536), 4).problem(shape):
        raise BadMessage("fields.spec", "not an environment specification")
    for name, rule in rules.items():
        if problem := rule.problem(table[name]):
            raise BadMessage(f"fields.spec.{name}", problem)
    if table["frame_dtype"] not in ("uint8", "float32"):
        raise BadMessage("fields.spec.frame_dtype", f"{table['frame_dtype']!r}; uint8 or float32")
    return EnvSpec(**{**table, "frame_shape": tuple(table["frame_shape"])})


def encode_ack(run: str, inserted: int) -> bytearray:
    """Build the receipt of a segment; `inserted` is the table's count of accepted transitions."""
    return wire.encode("ack", run, {"inserted": inserted})


def decode_ack(message: Message) -> int:
    """Read a receipt: accepted transitions so far; raises BadMessage."""
    _ACK.check(message)
    return int(message.fields["inserted"])


def encode_retry(run: str, reason: str) -> bytearray:
    """Build the limiter's refusal."""
    return wire.encode("retry", run, {"reason": reason})


def decode_retry(message: Message) -> str:
    """Read the reason of a refusal; raises BadMessage."""
    _RETRY.check(message)
    return str(message.fields["reason"])


def encode_error(run: str, error: CoopError) -> bytearray:
    """Build the answer to a bad message, or to one that could not be carried out."""
    field = error.field if isinstance(error, BadMessage) else ""
    return wire.encode("error", run, {"field": field, "problem": str(error)[:4096]})


def decode_error(message: Message) -> str:
    """Read what a peer found wrong; raises BadMessage."""
    _ERROR.check(message)
    return str(message.fields["problem"])


def encode_weights(run: str, network: int, version: int, flat: Array) -> bytearray:
    """Build a broadcast of one network: float32 [P]."""
    return wire.encode("weights", run, {"network": network, "version": version}, {"flat": flat})


def decode_weights(message: Message, parameters: int) -> tuple[int, int, Array]:
    """Read (network, version, flat); raises BadMessage."""
    Schema("weights", {"network": Int(1, 2), "version": Int()}, {"flat": ("float32", (parameters,))}).check(message)
    return message.fields["network"], message.fields["version"], message.arrays["flat"]


def encode_role(run: str, role: Role) -> bytearray:
    """Build a broadcast of the acting role."""
    return wire.encode("role", run, asdict(role))


def decode_role(message: Message) -> Role:
    """Read the acting role; raises BadMessage."""
    _ROLE.check(message)
    first, second = message.fields["versions"]
    return Role(message.fields["acting"], (first, second), message.fields["updates"])


def encode_question(run: str, kind: str) -> bytearray:
    """Build a question that carries nothing but its kind."""
    return wire.encode(kind, run, {})


def decode_question(kind: str, message: Message) -> None:
    """Check a question; raises BadMessage."""
    Schema(kind, {}, {}).check(message)


def encode_stats(run: str, stats: ReplayStats) -> bytearray:
    """Build the answer to a question for counters."""
    return wire.encode("stats", run, asdict(stats))


def decode_stats(message: Message) -> ReplayStats:
    """Read counters; raises BadMessage."""
    _STATS.check(message)
    return ReplayStats(**message.fields)


def encode_snapshot(run: str, number: int, keep: list[int]) -> bytearray:
    """Build the request to begin the replay service's part of epoch `number`; of older ones it keeps `keep` alone."""
    return wire.encode("snapshot", run, {"number": number, "keep": keep})


def decode_snapshot(message: Message) -> tuple[int, list[int]]:
    """Read (number, keep); raises BadMessage."""
    _SNAPSHOT.check(message)
    return message.fields["number"], message.fields["keep"]


def encode_written(run: str, number: int) -> bytearray:
    """Build the question whether the replay service's part of epoch `number` is on disk."""
    return wire.encode("written", run, {"number": number})


def decode_written(message: Message) -> int:
    """Read the number of the epoch that is asked for; raises BadMessage."""
    _WRITTEN.check(message)
    return int(message.fields["number"])


def encode_stop(run: str, reason: str) -> bytearray:
    """Build the broadcast that ends the run."""
    return wire.encode("stop", run, {"reason": reason[:1024]})


def decode_stop(message: Message) -> str:
    """Read why the run ends; raises BadMessage."""
    _STOP.check(message)
    return str(message.fields["reason"])
