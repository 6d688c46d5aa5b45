"""Transitions: the schema of their columns, segments, batches, and draws.

Each column is declared once, in `Transitions` or `Batch`. The arrays of messages and their checks, the columns of a
table, and the estimates of memory follow from the declarations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from coop.common.bounded import Count, Counter, Incarnation, Updates
from coop.common.bounds import (
    MAX_AHEAD,
    MAX_BATCH,
    MAX_FLOAT32,
    MAX_INTEGER,
    MAX_MAGNITUDE,
    MAX_N_STEP,
    MAX_SEGMENT_STEPS,
    MAX_STREAMS,
    MAX_UPDATES,
)
from coop.common.process.shared_memory import ADDRESS
from coop.common.types import Array, EnvSpec, EpisodeEnd, EpisodeRecord

MAX_EPISODES = 1000  # in one answer; the next answer carries the rest

Bounds = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Column:
    """What an array with a row for each transition may hold.

    limits: least and largest value, or what gives them for an environment and the arrays beside this one; None for
    indices of frames. kept: by the table, for each transition that it holds. usual: the value where nothing else is
    known, see `filled`. of_actions: a row has a value for each action; only environments with masks have such a column.
    """

    limits: Bounds | Callable[[EnvSpec, Mapping[str, Array]], Bounds] | None
    kept: bool = True
    usual: int = 0
    of_actions: bool = False


def _actions(spec: EnvSpec, arrays: Mapping[str, Array]) -> Bounds:
    return 0, spec.num_actions - 1


def _summed_rewards(spec: EnvSpec, arrays: Mapping[str, Array]) -> Bounds:
    most = MAX_MAGNITUDE * max(1, int(arrays["span"].max()))
    return -most, most


FRAME_INDICES = Column(None, kept=False)
MASK = Column((0, 1), of_actions=True)


class Masked(Struct, frozen=True, kw_only=True):
    """Action masks of n transitions; None unless `EnvSpec.masks`.

    mask, next_mask: bool [n, actions], the actions allowed at obs and at next_obs.
    """

    mask: Annotated[NDArray[np.bool_] | None, MASK] = None
    next_mask: Annotated[NDArray[np.bool_] | None, MASK] = None


class Transitions(Masked, frozen=True):
    """What segments and batches say of each of n transitions.

    frames: <frame_dtype>[n_frames, *frame_shape], each frame once.
    obs_index, next_index: int32 [n, stack], rows of `frames` that make obs and next_obs (oldest first).
    actions: int32 [n]. rewards: float32 [n], n-step returns. terminated: bool [n].
    param_version: int64 [n], the version of the parameters that chose each action.
    span: uint8 [n], environment steps from obs to next_obs.
    """

    frames: Array
    obs_index: Annotated[NDArray[np.int32], FRAME_INDICES]
    next_index: Annotated[NDArray[np.int32], FRAME_INDICES]
    actions: Annotated[NDArray[np.int32], Column(_actions)]
    rewards: Annotated[NDArray[np.float32], Column(_summed_rewards)]
    terminated: Annotated[NDArray[np.bool_], Column((0, 1))]
    param_version: Annotated[NDArray[np.int64], Column((0, MAX_UPDATES))]
    span: Annotated[NDArray[np.uint8], Column((1, MAX_N_STEP), usual=1)]

    def __len__(self) -> int:
        return len(self.actions)


class Segment(Transitions, frozen=True):
    """Transitions from consecutive steps of one emulator stream, as an actor sends them.

    carried: how many leading frames repeat, bit for bit, the last frames of this stream's previous segment
        (sequence numbers count per stream, so that is `sequence - 1`); a table that still holds those
        frames keeps one copy. 0 at the start of a stream.
    acked: transitions of this incarnation that had been acknowledged when this segment was first sent.
    """

    incarnation: Incarnation
    stream: Annotated[int, Meta(ge=0, lt=MAX_STREAMS)]
    sequence: Count
    carried: Annotated[int, Meta(ge=0, le=1024)] = 0
    acked: Count = 0
    episodes: Annotated[tuple[EpisodeEnd, ...], Meta(max_length=MAX_SEGMENT_STEPS)] = ()

    @property
    def steps(self) -> int:
        """Transitions in this segment."""
        return len(self.actions)


class Batch(Transitions, frozen=True):
    """Transitions drawn from a table.

    weights: float32 [batch], importance-sampling weights (all 1 for uniform sampling).
    ids: int64 [batch], the number of each transition in order of insertion, from 0; priority updates refer to it.
    age: int64 [batch], transitions inserted since this one.
    reuse: int32 [batch], how often each has been drawn, including this draw.
    """

    weights: Annotated[NDArray[np.float32], Column((0, MAX_FLOAT32), kept=False, usual=1)]
    ids: Annotated[NDArray[np.int64], Column((0, MAX_INTEGER))]
    age: Annotated[NDArray[np.int64], Column((0, MAX_INTEGER), kept=False)]
    reuse: Annotated[NDArray[np.int32], Column((0, MAX_INTEGER), usual=1)]

    def columns(self) -> dict[str, Array]:
        """All arrays except the frames, by name."""
        return arrays_of(self, IN_BATCH)


class Field(NamedTuple):
    """A column with its dtype."""

    dtype: np.dtype[Any]
    column: Column

    def row_shape(self, spec: EnvSpec) -> tuple[int, ...]:
        """Of one transition's entry."""
        if self.column.of_actions:
            return (spec.num_actions,)
        return (spec.stack,) if self.column is FRAME_INDICES else ()

    def bounds(self, spec: EnvSpec, arrays: Mapping[str, Array]) -> Bounds | None:
        """Least and largest value beside these arrays, of at least one row; None for indices of frames."""
        limits = self.column.limits
        return limits(spec, arrays) if callable(limits) else limits


def _fields(kind: type[Transitions]) -> dict[str, Field]:
    fields = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        array, *extras = get_args(hint) or (hint,)
        for column in extras:
            if isinstance(column, Column):
                fields[name] = Field(_dtype(array), column)
    return fields


def _dtype(hint: Any) -> np.dtype[Any]:  # noqa: ANN401
    """The dtype of NDArray[...]: an alias of its own from numpy 2.5 on, before that ndarray[..., dtype[...]]."""
    while parts := [part for part in get_args(hint) if part is not type(None)]:
        hint = parts[-1]
    dtype: np.dtype[Any] = np.dtype(hint)
    return dtype


MASKS = {name: field for name, field in _fields(Transitions).items() if field.column.of_actions}
IN_SEGMENT, IN_BATCH = (
    {name: field for name, field in _fields(kind).items() if name not in MASKS} for kind in (Segment, Batch)
)
FIELDS = {**IN_SEGMENT, **IN_BATCH}
KEPT = {name: field for name, field in FIELDS.items() if field.column.kept}


def columns_of(fields: Mapping[str, Field], spec: EnvSpec) -> Mapping[str, Field]:
    """These columns as this environment's transitions have them: with masks, if it has masks."""
    return {**fields, **MASKS} if spec.masks else fields


def arrays_of(transitions: Transitions, fields: Mapping[str, Field]) -> dict[str, Array]:
    """The arrays in these columns, by name, and the masks if there are any."""
    names = fields if transitions.mask is None else (*fields, *MASKS)
    return {name: getattr(transitions, name) for name in names}


def row_bytes(fields: Mapping[str, Field], spec: EnvSpec) -> int:
    """Bytes of one transition in all these columns."""
    found = columns_of(fields, spec).values()
    return sum(field.dtype.itemsize * math.prod(field.row_shape(spec)) for field in found)


def layout(fields: Mapping[str, Field], spec: EnvSpec, rows: str) -> dict[str, tuple[str, tuple[int | str, ...]]]:
    """Dtype and shape of the frames and of these columns; the words "frames" and `rows` stand for the lengths."""
    found: dict[str, tuple[str, tuple[int | str, ...]]] = {"frames": (spec.frame_dtype, ("frames", *spec.frame_shape))}
    for name, field in columns_of(fields, spec).items():
        found[name] = field.dtype.name, (rows, *field.row_shape(spec))
    return found


def filled(fields: Mapping[str, Field], rows: int, given: Mapping[str, Array | None]) -> dict[str, Array]:
    """These columns of so many transitions: the given ones, with their dtypes, and usual values in the others.

    Of masks only those that are given.
    """
    there = {name: array for name, array in given.items() if array is not None}
    masks = {name: field for name, field in MASKS.items() if name in there}
    return {
        name: there[name].astype(field.dtype, copy=False)
        if name in there
        else np.full(rows, field.column.usual, field.dtype)
        for name, field in {**fields, **masks}.items()
    }


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


NO_IDS, NO_PRIORITIES = np.empty(0, np.int64), np.empty(0, np.float32)


class DrawRequest(Struct, frozen=True):
    """A request for the batches of `draws` updates from number `sequence` on; a repeated request gets the same batches.

    base: updates that the learner will not repeat: it never asks again for a batch below. A replay service that
        has drawn fewer, or that served another incarnation, sets its own count of draws to it.
    episodes_from: number of the first episode that the learner has not received.
    memory: the memory of the table's frames if the learner reads them there; "" if it could, but doesn't know where.
    mirror, mirror_slots: the number of the learner's mirror of the table's frames, and its size; 0 if it has none.
        Without memory or mirror, a request is for one batch, and the answer carries all its frames.
    ids, priorities: int64 [n] and float32 [n], transitions and their new priorities, set before the draw.
    """

    incarnation: Incarnation
    sequence: Annotated[int, Meta(ge=0, lt=MAX_UPDATES + MAX_AHEAD)]
    base: Updates
    batch_size: Annotated[int, Meta(ge=1, le=MAX_BATCH)]
    episodes_from: Count
    memory: Annotated[str, Meta(pattern=f"{ADDRESS}|^$")] | None = None
    mirror: Counter = 0
    mirror_slots: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    draws: Annotated[int, Meta(ge=1, le=MAX_AHEAD)] = 1
    ids: NDArray[np.int64] = NO_IDS
    priorities: NDArray[np.float32] = NO_PRIORITIES
