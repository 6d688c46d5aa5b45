"""Messages that carry experience: segments on their way to the table, draws and batches on their way out.

insert    a segment for the table
sample    a request for a batch
batch     its answer; also carries the episodes that ended
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np

from common.bounds import MAX_AHEAD, MAX_BATCH, MAX_N_STEP, MAX_SEGMENT_STEPS, MAX_STREAMS
from common.errors import BadMessage
from common.messaging import wire
from common.messaging.messages import INCARNATION
from common.messaging.schema import Int, ListOf, Real, Row, Rule, Schema
from common.messaging.wire import Message, Source
from common.types import Array, Batch, EnvSpec, EpisodeEnd, Segment

MAX_EPISODES = 1000  # told with one batch; later ones come with the next


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
    """What the table says beside a batch: its counters, and the episodes from number `first_episode` on.

    planned: batches that the complete run will have drawn.
    """

    sequence: int
    inserted: int
    size: int
    evicted: int
    evicted_unsampled: int
    first_episode: int
    episodes: tuple[EpisodeRecord, ...]
    planned: int = 0


@dataclass(frozen=True, slots=True)
class DrawRequest:
    """A request for the batch of update number `sequence`; repeated, it is answered with the same batch.

    base: updates that the learner has done for good: it never asks again for a batch below. A replay service that
        has drawn less than that, or that served another incarnation, takes it for its own count of draws.
    episodes_from: number of the first episode that the learner has not been told of.
    priorities: new priorities (id of a transition, |TD error|), to be set before the draw.
    """

    incarnation: int
    sequence: int
    base: int
    batch_size: int
    episodes_from: int
    priorities: tuple[tuple[int, float], ...] = ()


_EPISODE_END = Row((Int(0, MAX_SEGMENT_STEPS - 1), Real(), Int(1), Real(), Real(), Real(), Int(-1)))
_EPISODE_RECORD = Row((Int(), Int(), Int(), _EPISODE_END))
_SAMPLE = Schema(
    "sample",
    {
        "incarnation": INCARNATION,
        "sequence": Int(),
        "base": Int(),
        "batch_size": Int(1, MAX_BATCH),
        "episodes_from": Int(),
        "priorities": ListOf(Row((Int(), Real())), 2 * MAX_BATCH),
    },
    {},
)
_DRAWN_FIELDS: dict[str, Rule] = {
    "sequence": Int(),
    "inserted": Int(),
    "size": Int(),
    "evicted": Int(),
    "evicted_unsampled": Int(),
    "first_episode": Int(),
    "episodes": ListOf(_EPISODE_RECORD, MAX_EPISODES),
    "planned": Int(),
}
_SEGMENT_FIELDS: dict[str, Rule] = {
    "incarnation": INCARNATION,
    "stream": Int(0, MAX_STREAMS - 1),
    "sequence": Int(),
    "carried": Int(0, 1024),
    "acked": Int(),
    "episodes": ListOf(_EPISODE_END, MAX_SEGMENT_STEPS),
}


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


_SEGMENT_ARRAYS = ("frames", "obs_index", "next_index", "actions", "rewards", "terminated", "param_version", "span")
_OPTIONAL = frozenset({"span"})  # journals and snapshots from before n-step returns lack it


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
                "span": ("uint8", ("steps",)),
            },
            _OPTIONAL,
        )

    def __call__(self, message: Message) -> Segment:
        """Read one; raises BadMessage for anything the table could not take."""
        lengths = self._schema.check(message)
        fields, arrays = message.fields, message.arrays
        steps, frames = lengths["steps"], lengths["frames"]
        if not 1 <= steps <= MAX_SEGMENT_STEPS:
            raise BadMessage("arrays.actions", f"{steps} steps; allowed: 1 to {MAX_SEGMENT_STEPS}")
        _check_transitions(self._spec, arrays)
        _within("arrays.param_version", arrays["param_version"], 0, 2**62)
        if fields["carried"] > frames:
            raise BadMessage("fields.carried", f"{fields['carried']} of {frames} frames")
        episodes = tuple(EpisodeEnd(*row) for row in fields["episodes"])
        if any(end.step_in_segment >= steps for end in episodes):
            raise BadMessage("fields.episodes", "an episode ends beyond the segment")
        values: dict[str, Any] = {**fields, **arrays, "episodes": episodes}
        return Segment(**values)


def _check_transitions(spec: EnvSpec, arrays: Mapping[str, Array]) -> None:
    """Check the values that segments and batches share: at least one transition each."""
    frames = arrays["frames"]
    for name in ("obs_index", "next_index"):
        _within(f"arrays.{name}", arrays[name], 0, len(frames) - 1)
    _within("arrays.actions", arrays["actions"], 0, spec.num_actions - 1)
    _finite("arrays.rewards", arrays["rewards"])
    if frames.dtype == np.float32:
        _finite("arrays.frames", frames)
    if arrays["terminated"].view(np.uint8).max() > 1:
        raise BadMessage("arrays.terminated", "not boolean")
    if "span" in arrays:
        _within("arrays.span", arrays["span"], 1, MAX_N_STEP)


def _finite(field: str, array: Array) -> None:
    if not np.isfinite(array).all():
        raise BadMessage(field, "not finite")


def _within(field: str, array: Array, low: int, high: int) -> None:
    if array.min() < low or array.max() > high:
        raise BadMessage(field, f"values from {array.min()} to {array.max()}; allowed: {low} to {high}")


def encode_sample(run: str, request: DrawRequest) -> bytearray:
    """Build a draw request."""
    return wire.encode("sample", run, asdict(request))


def decode_sample(message: Message) -> DrawRequest:
    """Read a draw request; raises BadMessage."""
    _SAMPLE.check(message)
    fields = {**message.fields, "priorities": tuple(map(tuple, message.fields["priorities"]))}
    request = DrawRequest(**fields)
    if any(priority < 0 for _, priority in request.priorities):
        raise BadMessage("fields.priorities", "a priority below 0")
    if not request.base <= request.sequence < request.base + MAX_AHEAD:
        allowed = f"{request.base} to {request.base + MAX_AHEAD - 1}"
        raise BadMessage("fields.sequence", f"{request.sequence}; with base {request.base}: {allowed}")
    return request


def encode_batch(
    run: str, frames: Array | Source, columns: Mapping[str, Array], drawn: Drawn, into: bytearray | None = None
) -> bytearray:
    """Build the answer to a draw: the frames of a batch and its other fields; into: see `wire.encode`."""
    fields = {name: getattr(drawn, name) for name in _DRAWN_FIELDS}
    fields["episodes"] = [astuple(record) for record in drawn.episodes]
    return wire.encode("batch", run, fields, {"frames": frames, **columns}, into)


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
                "span": ("uint8", row),
            },
            _OPTIONAL,
        )
        self._spec = spec

    def __call__(self, message: Message) -> tuple[Batch, Drawn]:
        """Read one; raises BadMessage."""
        if not self._schema.check(message)["batch"]:
            raise BadMessage("arrays.actions", "an empty batch")
        _check_transitions(self._spec, message.arrays)
        _finite("arrays.weights", message.arrays["weights"])
        fields = dict(message.fields)
        fields["episodes"] = tuple(
            EpisodeRecord(step, actor, stream, EpisodeEnd(*end)) for step, actor, stream, end in fields["episodes"]
        )
        return Batch(**message.arrays), Drawn(**fields)
