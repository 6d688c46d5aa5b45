"""Draws: the request for a batch, and its answer, which also carries the episodes that ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from coop.common.bounded import Counter, Incarnation
from coop.common.bounds import MAX_AHEAD, MAX_FLOAT32, MAX_INTEGER
from coop.common.errors import BadMessage
from coop.common.messaging import wire
from coop.common.messaging.messages.body import Body, Layout, check_kind, to_struct
from coop.common.messaging.messages.insert import check_indices, check_range, check_values
from coop.common.messaging.wire import Message, Source
from coop.common.process.shared_memory import ADDRESS
from coop.common.transitions import IN_BATCH, Batch, Drawn, DrawRequest, columns_of, layout
from coop.common.types import Array, EnvSpec

KIND = "batch"
NAMED = "batches"  # whose frames are named
REQUEST = "sample"

_PRIORITIES = Layout({"ids": ("int64", ("prioritised",)), "priorities": ("float32", ("prioritised",))})
_FIELDS = tuple(name for name in DrawRequest.__struct_fields__ if name not in _PRIORITIES.arrays)


def encode_request(run: str, request: DrawRequest) -> bytearray:
    """Build a request for batches."""
    fields = {name: getattr(request, name) for name in _FIELDS}
    return wire.encode(REQUEST, run, fields, {"ids": request.ids, "priorities": request.priorities})


def read_request(message: Message) -> DrawRequest:
    """Read a request for batches; raises BadMessage."""
    check_kind(message, REQUEST)
    _PRIORITIES.lengths(message.table)
    request = to_struct(message, DrawRequest, _PRIORITIES)
    check_range("arrays.ids", request.ids, 0, MAX_INTEGER)
    check_range("arrays.priorities", request.priorities, 0, MAX_FLOAT32)
    if not request.base <= request.sequence <= request.base + MAX_AHEAD - request.draws:
        allowed = f"{request.base} to {request.base + MAX_AHEAD - request.draws}"
        raise BadMessage("fields.sequence", f"{request.sequence}; with base {request.base}: {allowed}")
    if request.draws > 1 and not (request.memory or request.mirror):
        raise BadMessage("fields.draws", f"{request.draws}; allowed without memory or mirror: 1")
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


class Draws(Struct, frozen=True):
    """The data that accompany batches whose frames are named: those of each draw, in the order of the columns.

    table: a random id of the table whose frames are named. memory: where they lie, if the learner reads them there.
    frames: different frames of each batch. admitted: draws of lower numbers need not wait, whatever happens.
    """

    table: Incarnation
    memory: Annotated[str, Meta(pattern=f"{ADDRESS}|^$")]
    admitted: Counter
    frames: Annotated[tuple[Annotated[int, Meta(ge=1)], ...], Meta(max_length=MAX_AHEAD)]
    draws: Annotated[tuple[Drawn, ...], Meta(min_length=1, max_length=MAX_AHEAD)]


@dataclass(frozen=True, slots=True)
class NamedBatch:
    """A batch whose frames are named; see `FrameMirror`.

    table, memory: as in `Draws`. slots, numbers: of its different frames, int32 [n] and int64 [n].
    carried: which of them its answer carries, intp [m], and `frames`: those, [m, *frame_shape].
    columns: the other fields of a `Batch`, by name.
    """

    table: int
    memory: str
    slots: NDArray[np.int32]
    numbers: NDArray[np.int64]
    carried: NDArray[np.intp]
    frames: Array
    columns: Mapping[str, Array]


def encode_named(
    run: str,
    draws: Draws,
    columns: Sequence[Mapping[str, Array]],
    slots: Array,
    numbers: Array,
    carried: Array,
    frames: Source,
    into: bytearray,
) -> bytearray:
    """Build the answer with the named batches of one or several draws.

    slots, numbers: of all batches' frames, int [n]. carried, frames: the indices of those that the answer carries.
    """
    joined = columns[0]
    if len(columns) > 1:
        joined = {name: np.concatenate([each[name] for each in columns]) for name in joined}
    named = {"slots": slots.astype(np.int32), "numbers": numbers, "carried": carried.astype(np.int32)}
    return wire.encode(NAMED, run, draws, {"frames": frames, **named, **joined}, into)


class BatchReader:
    """Reads batches of one environment, with their frames."""

    def __init__(self, spec: EnvSpec) -> None:
        self._spec = spec
        self._layout = Layout(layout(IN_BATCH, spec, "batch"))

    def __call__(self, message: Message) -> tuple[Batch, Drawn]:
        """Read one; raises BadMessage."""
        check_kind(message, KIND)
        lengths = self._layout.lengths(message.table)
        if not lengths["batch"]:
            raise BadMessage("arrays.actions", "an empty batch")
        check_indices(message.arrays, lengths["frames"])
        check_values(self._spec, message.arrays)
        return Batch(**message.arrays), to_struct(message, Drawn)


class NamedBatchReader:
    """Reads batches of one environment whose frames are named."""

    def __init__(self, spec: EnvSpec) -> None:
        self._spec = spec
        named: dict[str, tuple[str, tuple[int | str, ...]]] = {
            "slots": ("int32", ("named",)),
            "numbers": ("int64", ("named",)),
            "carried": ("int32", ("frames",)),
        }
        self._columns = columns_of(IN_BATCH, spec)
        self._layout = Layout({**layout(IN_BATCH, spec, "batch"), **named})

    def __call__(self, message: Message) -> tuple[Draws, list[NamedBatch]]:
        """Read those of one answer, at least one; raises BadMessage."""
        check_kind(message, NAMED)
        lengths, arrays = self._layout.lengths(message.table), message.arrays
        draws = to_struct(message, Draws)
        count, named = len(draws.draws), lengths["named"]
        size, rest = divmod(lengths["batch"], count)
        if not size or rest:
            raise BadMessage("arrays.actions", f"{lengths['batch']} transitions of {count} batches")
        if len(draws.frames) != count or sum(draws.frames) != named:
            raise BadMessage("fields.frames", f"{draws.frames}; {named} in {count} batches")
        check_values(self._spec, arrays)
        check_range("arrays.slots", arrays["slots"], 0, MAX_INTEGER)
        check_range("arrays.numbers", arrays["numbers"], 1, MAX_INTEGER)
        carried = arrays["carried"].astype(np.intp)
        check_range("arrays.carried", carried, 0, named - 1)
        if not (carried[1:] > carried[:-1]).all():
            raise BadMessage("arrays.carried", "not in ascending order")
        batches, start = [], 0
        for place, frames in enumerate(draws.frames):
            stop = start + frames
            low, high = (0, len(carried)) if count == 1 else carried.searchsorted((start, stop))
            rows = slice(place * size, (place + 1) * size)
            columns = {name: arrays[name][rows] for name in self._columns}
            check_indices(columns, frames)
            batches.append(
                NamedBatch(
                    draws.table,
                    draws.memory,
                    arrays["slots"][start:stop],
                    arrays["numbers"][start:stop],
                    carried[low:high] - start,
                    arrays["frames"][low:high],
                    columns,
                )
            )
            start = stop
        return draws, batches
