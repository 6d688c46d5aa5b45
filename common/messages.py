"""Every kind of message: its schema, how it is built and how it is read back.

join / joined        a role asks the learner for the run
insert / ack         a segment for the table, and its receipt
sample / batch       the learner draws; also carries the episodes that ended
retry                the limiter's answer to an insert or a sample, with the reason in words
weights, role        the learner's broadcasts
status               what a role is doing, for displays
stats, snapshot      questions to the replay service
error                the answer to a bad message: the field and the problem
"""

from __future__ import annotations

import re
from dataclasses import asdict, astuple, dataclass
from dataclasses import fields as dataclass_fields
from typing import Any

import numpy as np

from common import wire
from common.config import RunConfig, to_tables, validated
from common.errors import BadMessage, UsageError
from common.schema import Int, ListOf, Real, Row, Schema, Table, Text
from common.types import Array, Batch, EnvSpec, EpisodeEnd, Segment
from common.wire import Message

MAX_SEGMENT_STEPS = 4096
ROLES = ("learner", "replay", "actor")

_INCARNATION = Int(0, 2**63 - 1)
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
class EpisodeRecord:
    """A finished episode as the replay service books it, in order of acceptance.

    env_step: transitions accepted up to the episode's last step.
    """

    env_step: int
    actor: int
    stream: int
    end: EpisodeEnd


@dataclass(frozen=True, slots=True)
class Drawn:
    """What the table says beside a batch: its counters, and the episodes from number `first_episode` on."""

    sequence: int
    inserted: int
    size: int
    evicted: int
    evicted_unsampled: int
    first_episode: int
    episodes: tuple[EpisodeRecord, ...]


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


_JOIN = Schema("join", {"role": Text(16), "incarnation": _INCARNATION, "endpoints": _ENDPOINTS}, {})
_JOINED = Schema(
    "joined",
    {"config": Table(), "spec": Table(), "layout": Text(64), "index": Int(), "replay_endpoints": _ENDPOINTS},
    {},
)
_EPISODE_END = Row((Int(0, MAX_SEGMENT_STEPS - 1), Real(), Int(1), Real(), Real(), Real(), Int(-1)))
_EPISODE_RECORD = Row((Int(), Int(), Int(), _EPISODE_END))
_ACK = Schema("ack", {"inserted": Int()}, {})
_RETRY = Schema("retry", {"reason": Text()}, {})
_ERROR = Schema("error", {"field": Text(), "problem": Text(4096)}, {})
_SAMPLE = Schema(
    "sample",
    {"incarnation": _INCARNATION, "sequence": Int(), "batch_size": Int(1, 65_536), "episodes_from": Int()},
    {},
)
_ROLE = Schema("role", {"acting": Int(1, 2), "versions": Row((Int(), Int())), "updates": Int()}, {})
_STATS = Schema(
    "stats",
    {field.name: Text() if field.name.endswith("_wait_for") else Int() for field in dataclass_fields(ReplayStats)},
    {},
)
_SNAPSHOT = Schema("snapshot", {"folder": Text(256)}, {})
_FOLDER = re.compile(r"checkpoints/[0-9]{1,12}")
_DRAWN_FIELDS = {
    "sequence": Int(),
    "inserted": Int(),
    "size": Int(),
    "evicted": Int(),
    "evicted_unsampled": Int(),
    "first_episode": Int(),
    "episodes": ListOf(_EPISODE_RECORD, 100_000),
}
_SEGMENT_FIELDS = {
    "incarnation": _INCARNATION,
    "stream": Int(0, 65_535),
    "sequence": Int(),
    "carried": Int(0, 1024),
    "acked": Int(),
    "episodes": ListOf(_EPISODE_END, MAX_SEGMENT_STEPS),
}


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
    rules = {"env_id": Text(256), "frame_dtype": Text(16), "stack": Int(1, 64), "num_actions": Int(1, 100_000)}
    if table.keys() != {*rules, "frame_shape"} or ListOf(Int(1, 65_536), 4).problem(shape):
        raise BadMessage("fields.spec", "not an environment specification")
    for name, rule in rules.items():
        if problem := rule.problem(table[name]):
            raise BadMessage(f"fields.spec.{name}", problem)
    if table["frame_dtype"] not in ("uint8", "float32"):
        raise BadMessage("fields.spec.frame_dtype", f"{table['frame_dtype']!r}; uint8 or float32")
    return EnvSpec(**{**table, "frame_shape": tuple(table["frame_shape"])})


def encode_segment(run: str, segment: Segment) -> bytearray:
    """Build an insert request."""
    fields = {
        "incarnation": segment.incarnation,
        "stream": segment.stream,
        "sequence": segment.sequence,
        "carried": segment.carried,
        "acked": segment.acked,
        "episodes": [astuple(end) for end in segment.episodes],
    }
    arrays = {name: getattr(segment, name) for name in _SEGMENT_ARRAYS}
    return wire.encode("insert", run, fields, arrays)


_SEGMENT_ARRAYS = ("frames", "obs_index", "next_index", "actions", "rewards", "terminated", "param_version")


class SegmentReader:
    """Reads insert requests for one environment."""

    def __init__(self, spec: EnvSpec) -> None:
        self._spec = spec
        self._schema = Schema(
            "insert",
            _SEGMENT_FIELDS,
            {
                "frames": (spec.frame_dtype, ("frames", *spec.frame_shape)),
                "obs_index": ("int32", ("steps", spec.stack)),
                "next_index": ("int32", ("steps", spec.stack)),
                "actions": ("int32", ("steps",)),
                "rewards": ("float32", ("steps",)),
                "terminated": ("bool", ("steps",)),
                "param_version": ("int64", ("steps",)),
            },
        )

    def __call__(self, message: Message) -> Segment:
        """Read one; raises BadMessage for anything the table could not take."""
        lengths = self._schema.check(message)
        fields, arrays = message.fields, message.arrays
        steps, frames = lengths["steps"], lengths["frames"]
        if not 1 <= steps <= MAX_SEGMENT_STEPS:
            raise BadMessage("arrays.actions", f"{steps} steps; allowed: 1 to {MAX_SEGMENT_STEPS}")
        for name in ("obs_index", "next_index"):
            _within(f"arrays.{name}", arrays[name], 0, frames - 1)
        _within("arrays.actions", arrays["actions"], 0, self._spec.num_actions - 1)
        _within("arrays.param_version", arrays["param_version"], 0, 2**62)
        if not np.isfinite(arrays["rewards"]).all():
            raise BadMessage("arrays.rewards", "not finite")
        if arrays["frames"].dtype == np.float32 and not np.isfinite(arrays["frames"]).all():
            raise BadMessage("arrays.frames", "not finite")
        if arrays["terminated"].view(np.uint8).max() > 1:
            raise BadMessage("arrays.terminated", "not boolean")
        if fields["carried"] > frames:
            raise BadMessage("fields.carried", f"{fields['carried']} of {frames} frames")
        episodes = tuple(EpisodeEnd(*row) for row in fields["episodes"])
        if any(end.step_in_segment >= steps for end in episodes):
            raise BadMessage("fields.episodes", "an episode ends beyond the segment")
        return Segment(**{**fields, "episodes": episodes}, **arrays)


def _within(field: str, array: Array, low: int, high: int) -> None:
    if array.min() < low or array.max() > high:
        raise BadMessage(field, f"values from {array.min()} to {array.max()}; allowed: {low} to {high}")


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


def encode_error(run: str, error: BadMessage) -> bytearray:
    """Build the answer to a bad message."""
    return wire.encode("error", run, {"field": error.field, "problem": str(error)[:4096]})


def decode_error(message: Message) -> str:
    """Read what a peer found wrong; raises BadMessage."""
    _ERROR.check(message)
    return str(message.fields["problem"])


def encode_sample(run: str, incarnation: int, sequence: int, batch_size: int, episodes_from: int) -> bytearray:
    """Build a draw request; a repeated (incarnation, sequence) gets the same batch again."""
    fields = {
        "incarnation": incarnation,
        "sequence": sequence,
        "batch_size": batch_size,
        "episodes_from": episodes_from,
    }
    return wire.encode("sample", run, fields)


def decode_sample(message: Message) -> tuple[int, int, int, int]:
    """Read (incarnation, sequence, batch_size, episodes_from); raises BadMessage."""
    _SAMPLE.check(message)
    fields = message.fields
    return fields["incarnation"], fields["sequence"], fields["batch_size"], fields["episodes_from"]


_BATCH_ARRAYS = (*_SEGMENT_ARRAYS, "weights", "ids", "age", "reuse")


def encode_batch(run: str, batch: Batch, drawn: Drawn) -> bytearray:
    """Build the answer to a draw."""
    fields = {name: getattr(drawn, name) for name in _DRAWN_FIELDS}
    fields["episodes"] = [astuple(record) for record in drawn.episodes]
    return wire.encode("batch", run, fields, {name: getattr(batch, name) for name in _BATCH_ARRAYS})


class BatchReader:
    """Reads batches of one environment."""

    def __init__(self, spec: EnvSpec) -> None:
        row = ("batch",)
        self._schema = Schema(
            "batch",
            _DRAWN_FIELDS,
            {
                "frames": (spec.frame_dtype, ("frames", *spec.frame_shape)),
                "obs_index": ("int32", ("batch", spec.stack)),
                "next_index": ("int32", ("batch", spec.stack)),
                "actions": ("int32", row),
                "rewards": ("float32", row),
                "terminated": ("bool", row),
                "param_version": ("int64", row),
                "weights": ("float32", row),
                "ids": ("int64", row),
                "age": ("int64", row),
                "reuse": ("int32", row),
            },
        )
        self._spec = spec

    def __call__(self, message: Message) -> tuple[Batch, Drawn]:
        """Read one; raises BadMessage."""
        lengths = self._schema.check(message)
        for name in ("obs_index", "next_index"):
            _within(f"arrays.{name}", message.arrays[name], 0, lengths["frames"] - 1)
        _within("arrays.actions", message.arrays["actions"], 0, self._spec.num_actions - 1)
        fields = dict(message.fields)
        fields["episodes"] = tuple(
            EpisodeRecord(step, actor, stream, EpisodeEnd(*end)) for step, actor, stream, end in fields["episodes"]
        )
        return Batch(**message.arrays), Drawn(**fields)


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
    return wire.encode("stop", run, {"reason": reason})
