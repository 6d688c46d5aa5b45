"""Messages that steer a run: their schemas, how they are built and how they are read back.

join / joined        a role asks the learner for the run
insert / ack         a segment for the table, and its receipt
sample / batch       the learner draws; also carries the episodes that ended
retry                the limiter's answer to an insert or a sample, with the reason in words
weights, role, stop  the learner's broadcasts
status               what a role is doing, for displays
stats, snapshot      questions to the replay service
error                the answer to a message that is bad (names the field) or that could not be carried out
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from dataclasses import fields as dataclass_fields
from typing import Any

from common import wire
from common.config import RunConfig, to_tables, validated
from common.errors import BadMessage, CoopError, UsageError
from common.schema import Int, ListOf, Row, Rule, Schema, Table, Text
from common.types import Array, EnvSpec
from common.wire import Message

ROLES = ("learner", "replay", "actor")

INCARNATION = Int(0, 2**63 - 1)
_ENDPOINTS = ListOf(Text(256), 16)


@dataclass(frozen=True, slots=True)
class Join:
    """A process asks to be part of the run; `endpoints` are where others can reach it (none for actors)."""

    role: str
    incarnation: int
    endpoints: list[str]


@dataclass(frozen=True, slots=True)
class Joined:
    """All that a role needs.

    replay_endpoints: where the replay service listens; empty while none has joined.
    index: how many processes of this role had joined before (tells actors' random streams apart).
    layout: digest of the network layout, to be compared with one's own.
    """

    config: RunConfig
    spec: EnvSpec
    layout: str
    index: int
    replay_endpoints: list[str]


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


_JOIN = Schema("join", {"role": Text(16), "incarnation": INCARNATION, "endpoints": _ENDPOINTS}, {})
_JOINED = Schema(
    "joined",
    {"config": Table(), "spec": Table(), "layout": Text(64), "index": Int(), "replay_endpoints": _ENDPOINTS},
    {},
)
_ACK = Schema("ack", {"inserted": Int()}, {})
_RETRY = Schema("retry", {"reason": Text()}, {})
_ERROR = Schema("error", {"field": Text(), "problem": Text(4096)}, {})
_ROLE = Schema("role", {"acting": Int(1, 2), "versions": Row((Int(), Int())), "updates": Int()}, {})
_STATS = Schema(
    "stats",
    {field.name: Text() if field.name.endswith("_wait_for") else Int() for field in dataclass_fields(ReplayStats)},
    {},
)
_SNAPSHOT = Schema("snapshot", {"folder": Text(256)}, {})
_STOP = Schema("stop", {"reason": Text()}, {})
_FOLDER = re.compile(r"checkpoints/[0-9]{1,12}")


def encode_join(run: str, join: Join) -> bytearray:
    """Build a join request."""
    return wire.encode("join", run, asdict(join))


def decode_join(message: Message) -> Join:
    """Read a join request; raises BadMessage."""
    _JOIN.check(message)
    join = Join(**message.fields)
    if join.role not in ROLES:
        raise BadMessage("fields.role", f"{join.role!r}; one of {', '.join(ROLES)}")
    return join


def encode_joined(joined: Joined) -> bytearray:
    """Build the learner's answer."""
    fields = {
        "config": to_tables(joined.config),
        "spec": asdict(joined.spec),
        "layout": joined.layout,
        "index": joined.index,
        "replay_endpoints": joined.replay_endpoints,
    }
    return wire.encode("joined", joined.config.run, fields)


def decode_joined(message: Message) -> Joined:
    """Read the learner's answer; raises BadMessage."""
    _JOINED.check(message)
    fields = message.fields
    try:
        config = validated(fields["config"])
    except UsageError as error:
        raise BadMessage("fields.config", str(error)) from error
    return Joined(config, _spec(fields["spec"]), fields["layout"], fields["index"], fields["replay_endpoints"])


def _spec(table: dict[str, Any]) -> EnvSpec:
    shape = table.get("frame_shape")
    rules: dict[str, Rule] = {
        "env_id": Text(256),
        "frame_dtype": Text(16),
        "stack": Int(1, 64),
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


def encode_snapshot(run: str, folder: str) -> bytearray:
    """Build the request to save the table under `folder` of the run directory."""
    return wire.encode("snapshot", run, {"folder": folder})


def decode_snapshot(message: Message) -> str:
    """Read the folder of a snapshot request; raises BadMessage where it could lead elsewhere."""
    _SNAPSHOT.check(message)
    folder = str(message.fields["folder"])
    if not _FOLDER.fullmatch(folder):
        raise BadMessage("fields.folder", f"{folder!r}; checkpoints/NUMBER")
    return folder


def encode_stop(run: str, reason: str) -> bytearray:
    """Build the broadcast that ends the run."""
    return wire.encode("stop", run, {"reason": reason[:1024]})


def decode_stop(message: Message) -> str:
    """Read why the run ends; raises BadMessage."""
    _STOP.check(message)
    return str(message.fields["reason"])
