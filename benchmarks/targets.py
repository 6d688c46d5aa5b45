"""The roles' keys: a valid message for each key, and the most extreme messages that are still valid."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np

from coop.common.bounds import (
    MAX_COUNT,
    MAX_ENV_ID,
    MAX_FLOAT32,
    MAX_INTEGER,
    MAX_MAGNITUDE,
    MAX_N_STEP,
    MAX_SEGMENT_STEPS,
    MAX_STREAMS,
    MAX_UPDATES,
)
from coop.common.errors import BadMessage
from coop.common.messaging.keys import evaluations_key, join_key, replay_key, role_key, stop_key, weights_key
from coop.common.messaging.members import Origin
from coop.common.messaging.messages.control import EndOfRun, Join, JoinReply, Limit, LimitsQuestion, Snapshot, Written
from coop.common.messaging.messages.evaluate import GIF, Evaluated, EvaluationRow, Video
from coop.common.messaging.messages.insert import SegmentReader, encode_segment
from coop.common.messaging.messages.sample import encode_request, read_request
from coop.common.messaging.messages.status import StatsQuestion
from coop.common.messaging.messages.weights import Current
from coop.common.messaging.transport import Node
from coop.common.messaging.wire import Message
from coop.common.transitions import DrawRequest, Segment
from coop.common.types import EnvSpec, EpisodeEnd

RUN = "fuzz"


@dataclass(frozen=True)
class Target:
    """A key, a valid message for it, the role that counts bad messages there, and the check that raises BadMessage.

    public: an actor's certificate may send it, so no valid message may do harm.
    """

    key: str
    valid: bytes
    owner: str
    read: Callable[[Message], Any]
    answers: bool = True
    public: bool = False


def targets(node: Node, reply: JoinReply) -> list[Target]:
    """All keys to which learner and replay service listen."""
    spec, batch_size = reply.spec, reply.config.learner.batch_size
    segment = _segment(spec)

    def sample(message: Message) -> None:
        if read_request(message).batch_size != batch_size:
            raise BadMessage("fields.batch_size", "not this run's")

    def snapshot(message: Message) -> None:
        (Snapshot.decode if message.kind == "snapshot" else Written.decode)(message)

    def limiting(message: Message) -> None:
        if message.kind == "limit":
            Limit.decode(message)
        else:
            LimitsQuestion.decode(message)

    def joining(role: str, message: Message) -> None:
        if Join.decode(message).role != role:
            raise BadMessage("fields.role", "not this key's")

    def reporting(message: Message) -> None:
        (Video if message.kind == Video.kind else Evaluated).decode(message)

    result, video = EvaluationRow(0, 0, 1, 10, 1.0, 1.0, 0.0, 1.0), Video(1, 0, 0, np.frombuffer(GIF, np.uint8))
    draw = DrawRequest(1, 0, 0, batch_size, 0)
    mirrored = msgspec.structs.replace(draw, mirror=1, mirror_slots=1000, draws=2)
    made: list[tuple[str, bytearray, str, Callable[[Message], Any]]] = [
        (replay_key(node, "insert"), encode_segment(RUN, segment), "replay", SegmentReader(spec)),
        (replay_key(node, "sample"), encode_request(RUN, draw), "replay", sample),
        (replay_key(node, "sample"), encode_request(RUN, mirrored), "replay", sample),
        (replay_key(node, "limits"), Limit(1.0, 64.0).encode(RUN), "replay", limiting),
        (replay_key(node, "limits"), LimitsQuestion().encode(RUN), "replay", limiting),
        (replay_key(node, "stats"), StatsQuestion().encode(RUN), "replay", StatsQuestion.decode),
        (replay_key(node, "snapshot"), Snapshot(7, [3], 1, 0).encode(RUN), "replay", snapshot),
        (replay_key(node, "snapshot"), Written(7).encode(RUN), "replay", snapshot),
        *(
            (join_key(node, role), Join(role, 5, []).encode(RUN), "learner", partial(joining, role))
            for role in ("actor", "replay")
        ),
        (evaluations_key(node), Evaluated(1, 0, result).encode(RUN), "learner", reporting),
        (evaluations_key(node), video.encode(RUN), "learner", reporting),
        (weights_key(node, 1), Current().encode(RUN), "learner", Current.decode),
        (weights_key(node, 2), Current().encode(RUN), "learner", Current.decode),
        (role_key(node), Current().encode(RUN), "learner", Current.decode),
    ]
    public = {replay_key(node, "insert"), join_key(node, "actor"), weights_key(node, 1), weights_key(node, 2)}
    queried = [Target(key, bytes(payload), owner, read, public=key in public) for key, payload, owner, read in made]
    stop = Target(stop_key(node), bytes(EndOfRun.because("x").encode(RUN)), "replay", EndOfRun.decode, answers=False)
    return [*queried, stop]


def extremes(node: Node, spec: EnvSpec) -> Iterator[tuple[str, bytes]]:
    """Yield key and payload of messages that an actor's certificate may send, with all numbers at their largest."""
    for number, segment in enumerate(_extreme_segments(spec)):
        changed = msgspec.structs.replace(segment, stream=number)
        for sequence in (0, MAX_COUNT - 1, MAX_COUNT):
            yield (
                replay_key(node, "insert"),
                bytes(encode_segment(RUN, msgspec.structs.replace(changed, sequence=sequence))),
            )
    ends = tuple(_extreme_end(1, step) for step in range(MAX_SEGMENT_STEPS))
    yield replay_key(node, "insert"), bytes(encode_segment(RUN, _segment(spec, MAX_SEGMENT_STEPS, ends)))
    longest = "x" * MAX_ENV_ID
    for incarnation in (0, MAX_INTEGER):
        for origin in (Origin("", 0), Origin(longest, 2**31)):
            for index in (-1, 0, MAX_COUNT):
                join = Join(
                    "actor", incarnation, [longest] * 16, index, [MAX_UPDATES] * 16, serving=True, origin=origin
                )
                yield join_key(node, "actor"), bytes(join.encode(RUN))


def _extreme_segments(spec: EnvSpec) -> Iterator[Segment]:
    plain = _segment(spec)
    for name, value in (
        ("acked", MAX_COUNT),
        ("incarnation", MAX_INTEGER),
        ("incarnation", 0),
        ("carried", len(plain.frames)),
        ("rewards", np.full(plain.steps, MAX_MAGNITUDE, np.float32)),
        ("rewards", np.full(plain.steps, -MAX_MAGNITUDE, np.float32)),
        ("terminated", np.ones(plain.steps, np.bool_)),
        ("param_version", np.full(plain.steps, MAX_UPDATES)),
        ("span", np.full(plain.steps, MAX_N_STEP, np.uint8)),
    ):
        yield msgspec.structs.replace(plain, **{name: value})
    if spec.frame_dtype == "float32":
        for magnitude in (MAX_MAGNITUDE, -MAX_MAGNITUDE):
            yield msgspec.structs.replace(plain, frames=np.full_like(plain.frames, magnitude))
    for sign in (1, -1):
        yield msgspec.structs.replace(plain, episodes=(_extreme_end(sign),))
    yield msgspec.structs.replace(plain, stream=MAX_STREAMS - 1, acked=MAX_COUNT, incarnation=MAX_INTEGER)


def _extreme_end(sign: int, step: int = 0) -> EpisodeEnd:
    return EpisodeEnd(step, sign * 1e15, MAX_COUNT, 1.0, sign * MAX_FLOAT32, -sign * MAX_FLOAT32, MAX_UPDATES)


def _segment(spec: EnvSpec, steps: int = 4, episodes: tuple[EpisodeEnd, ...] | None = None) -> Segment:
    index = np.arange(steps, dtype=np.int32)[:, None] + np.zeros(spec.stack, np.int32)
    return Segment(
        incarnation=1,
        stream=0,
        sequence=0,
        frames=np.zeros((steps + 1, *spec.frame_shape), spec.frame_dtype),
        obs_index=index,
        next_index=index + 1,
        actions=np.zeros(steps, np.int32),
        rewards=np.zeros(steps, np.float32),
        terminated=np.zeros(steps, np.bool_),
        param_version=np.zeros(steps, np.int64),
        span=np.ones(steps, np.uint8),
        episodes=(EpisodeEnd(steps - 1, 1.0, steps, 0.1, 0.2, 0.3, 5),) if episodes is None else episodes,
    )
