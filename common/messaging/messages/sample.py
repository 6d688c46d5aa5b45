"""Draws: the request for a batch, and its answer, which also carries the episodes that ended."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Self

from msgspec import Meta, Struct

from common.bounded import Count, Counter, Incarnation, Updates
from common.bounds import MAX_AHEAD, MAX_BATCH, MAX_FLOAT32, MAX_PRIORITIES, MAX_STREAMS, MAX_UPDATES
from common.errors import BadMessage
from common.messaging import wire
from common.messaging.messages.body import Body, Layout, check_kind, to_struct
from common.messaging.messages.insert import OPTIONAL, check_range, check_transitions, transitions
from common.messaging.shared_frames import SharedFrames
from common.messaging.wire import Message, Source
from common.process.shared_memory import ADDRESS
from common.types import Array, Batch, EnvSpec, EpisodeEnd

MAX_EPISODES = 1000  # in one answer; the next answer carries the rest
KIND = "batch"

Priority = Annotated[float, Meta(ge=0, le=MAX_FLOAT32)]


class EpisodeRecord(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A finished episode as the replay service records it, in order of acceptance.

    env_step: transitions accepted up to the episode's last step.
    """

    env_step: Counter
    actor: Incarnation
    stream: Annotated[int, Meta(ge=0, lt=MAX_STREAMS)]
    end: EpisodeEnd


class Drawn(Struct, frozen=True):
    """The data that accompany a batch: the table's counters, and the episodes from number `first_episode` on.

    planned: draws of the complete run. terminal: transitions held that end in a terminal state.
    """

    sequence: Counter
    inserted: Counter
    size: Counter
    evicted: Counter
    evicted_unsampled: Counter
    first_episode: Counter
    episodes: Annotated[tuple[EpisodeRecord, ...], Meta(max_length=MAX_EPISODES)]
    planned: Counter = 0
    terminal: Counter = 0


class DrawRequest(Body, frozen=True):
    """A request for the batch of update number `sequence`; a repeated request gets the same batch.

    base: updates that the learner will not repeat: it never asks again for a batch below. A replay service that
        has drawn fewer, or that served another incarnation, sets its own count of draws to it.
    episodes_from: number of the first episode that the learner has not received.
    priorities: new priorities (id of a transition, |TD error|), set before the draw.
    memory: the memory of the table's frames if the learner reads them there; "" if it could, but doesn't know where.
        Otherwise the answer carries the frames.
    """

    kind: ClassVar[str] = "sample"

    incarnation: Incarnation
    sequence: Annotated[int, Meta(ge=0, lt=MAX_UPDATES + MAX_AHEAD)]
    base: Updates
    batch_size: Annotated[int, Meta(ge=1, le=MAX_BATCH)]
    episodes_from: Count
    priorities: Annotated[tuple[tuple[Counter, Priority], ...], Meta(max_length=MAX_PRIORITIES)] = ()
    memory: Annotated[str, Meta(pattern=f"{ADDRESS}|^$")] | None = None

    @classmethod
    def decode(cls, message: Message) -> Self:
        """Read it; raises BadMessage."""
        request = super().decode(message)
        if not request.base <= request.sequence < request.base + MAX_AHEAD:
            allowed = f"{request.base} to {request.base + MAX_AHEAD - 1}"
            raise BadMessage("fields.sequence", f"{request.sequence}; with base {request.base}: {allowed}")
        return request


class Memory(Body, frozen=True):
    """Says where the frames of the table lie, so that the learner asks again and reads them there, or cannot."""

    kind: ClassVar[str] = "memory"

    address: Annotated[str, Meta(pattern=ADDRESS)]


def encode_batch(
    run: str, frames: Array | Source, columns: Mapping[str, Array], drawn: Drawn, into: bytearray | None = None
) -> bytearray:
    """Build the answer to a draw from a batch's frames and its other columns; into: see `wire.encode`."""
    return wire.encode(KIND, run, drawn, {"frames": frames, **columns}, into)


def encode_slots(run: str, slots: Array, columns: Mapping[str, Array], drawn: Drawn) -> bytearray:
    """Build the answer to a draw whose frames, in these slots, int64 [unique], the learner reads in the table."""
    return wire.encode(KIND, run, drawn, {"slots": slots, **columns})


class BatchReader:
    """Reads batches of one environment."""

    def __init__(self, spec: EnvSpec) -> None:
        self._spec = spec
        columns = {
            **transitions(spec, "batch"),
            "weights": ("float32", ("batch",)),
            "ids": ("int64", ("batch",)),
            "age": ("int64", ("batch",)),
            "reuse": ("int32", ("batch",)),
        }
        frames = columns.pop("frames")
        self._layout = Layout({"frames": frames, **columns}, OPTIONAL)
        self._layout_of_slots = Layout({"slots": ("int64", ("frames",)), **columns}, OPTIONAL)

    def __call__(self, message: Message, shared: SharedFrames | None = None) -> tuple[Batch, Drawn]:
        """Read one; shared: where its frames may lie. Raises BadMessage."""
        check_kind(message, KIND)
        arrays = dict(message.arrays)
        slots = None if shared is None else arrays.pop("slots", None)
        layout = self._layout if slots is None else self._layout_of_slots
        if not layout.lengths(message.table)["batch"]:
            raise BadMessage("arrays.actions", "an empty batch")
        if shared is not None and slots is not None:
            arrays["frames"] = shared.read(slots)
        check_transitions(self._spec, arrays)
        check_range("arrays.weights", arrays["weights"], 0.0, MAX_FLOAT32)
        return Batch(**arrays), to_struct(message, Drawn)
