"""The data that roles exchange: environment specification, segments of experience and batches."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from coop.common.bounded import Count, Counter, Float32, Incarnation, Name, Share
from coop.common.bounds import (
    MAX_ACTIONS,
    MAX_COUNT,
    MAX_RETURN,
    MAX_SEGMENT_STEPS,
    MAX_SIDE,
    MAX_STACK,
    MAX_STREAMS,
    MAX_UPDATES,
)

Array = NDArray[Any]


class EnvSpec(Struct, frozen=True, forbid_unknown_fields=True):
    """The properties of an environment that networks and tables need.

    frame_shape: shape of one stored frame: a vector, e.g. (4,) on CartPole, or a picture, (height, width) or (height,
        width, channels), e.g. (84, 84) on Atari.
    frame_dtype: "uint8", "bool" or "float32".
    stack: frames in one observation (1: the frame is the observation).
    num_actions: size of the Discrete action space.
    """

    env_id: Name
    frame_shape: Annotated[tuple[Annotated[int, Meta(ge=1, le=MAX_SIDE)], ...], Meta(min_length=1, max_length=3)]
    frame_dtype: Annotated[str, Meta(pattern="^(uint8|bool|float32)$")]
    stack: Annotated[int, Meta(ge=1, le=MAX_STACK)]
    num_actions: Annotated[int, Meta(ge=1, le=MAX_ACTIONS)]

    @property
    def obs_shape(self) -> tuple[int, ...]:
        """Shape of one observation: (stack, *frame_shape), or frame_shape if stack is 1."""
        return self.frame_shape if self.stack == 1 else (self.stack, *self.frame_shape)

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Shape of a network's input for one observation: that of a vector, or (stack x channels, height, width)."""
        if len(self.frame_shape) == 1:
            return self.obs_shape
        height, width, *channels = self.frame_shape
        return self.stack * math.prod(channels), height, width


class EpisodeEnd(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """One finished episode, which the actor reports in the segment that ends it.

    step_in_segment: index of the episode's last step in its segment.
    episode_return: sum of unclipped rewards. length: agent decisions.
    q1_mean, q2_mean: mean over actions of Q1 and Q2 at the last observation.
    """

    step_in_segment: Annotated[int, Meta(ge=0, lt=MAX_SEGMENT_STEPS)]
    episode_return: Annotated[float, Meta(ge=-MAX_RETURN, le=MAX_RETURN)]
    length: Annotated[int, Meta(ge=1, le=MAX_COUNT)]
    epsilon: Share
    q1_mean: Float32
    q2_mean: Float32
    param_version: Annotated[int, Meta(ge=-1, le=MAX_UPDATES)]


class EpisodeRecord(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A finished episode as the replay service records it, in order of acceptance.

    env_step: transitions accepted up to the episode's last step.
    """

    env_step: Counter
    actor: Incarnation
    stream: Annotated[int, Meta(ge=0, lt=MAX_STREAMS)]
    end: EpisodeEnd


class EpisodeRow(NamedTuple):
    """One finished episode for episodes.csv: its number, the actor's record, updates done, and the scale of s."""

    number: int
    record: EpisodeRecord
    update: int
    s: float


class Segment(Struct, frozen=True, forbid_unknown_fields=True):
    """Transitions from consecutive steps of one emulator stream, as an actor sends them.

    frames: <frame_dtype>[n_frames, *frame_shape], each frame once.
    obs_index, next_index: int32 [steps, stack], rows of `frames` that make obs and next_obs (oldest first).
    actions: int32 [steps]. rewards: float32 [steps], n-step returns. terminated: bool [steps].
    param_version: int64 [steps], the version of the parameters that chose each action.
    span: uint8 [steps], environment steps from obs to next_obs.
    carried: how many leading frames repeat, bit for bit, the last frames of this stream's previous segment
        (sequence numbers count per stream, so that is `sequence - 1`); a table that still holds those
        frames keeps one copy. 0 at the start of a stream.
    acked: transitions of this incarnation that had been acknowledged when this segment was first sent.
    """

    incarnation: Incarnation
    stream: Annotated[int, Meta(ge=0, lt=MAX_STREAMS)]
    sequence: Count
    frames: Array
    obs_index: NDArray[np.int32]
    next_index: NDArray[np.int32]
    actions: NDArray[np.int32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    param_version: NDArray[np.int64]
    span: NDArray[np.uint8]
    carried: Annotated[int, Meta(ge=0, le=1024)] = 0
    acked: Count = 0
    episodes: Annotated[tuple[EpisodeEnd, ...], Meta(max_length=MAX_SEGMENT_STEPS)] = ()

    @property
    def steps(self) -> int:
        """Transitions in this segment."""
        return len(self.actions)


@dataclass(frozen=True, slots=True)
class Batch:
    """Transitions drawn from a table, as unique frames plus indices into them.

    frames: <frame_dtype>[unique, *frame_shape].
    obs_index, next_index: int32 [batch, stack], rows of `frames`.
    actions: int32 [batch]. rewards: float32 [batch], n-step returns. terminated: bool [batch].
    weights: float32 [batch], importance-sampling weights (all 1 for uniform sampling).
    ids: int64 [batch], the number of each transition in order of insertion, from 0; priority updates refer to it.
    param_version: int64 [batch], version of the parameters that acted.
    age: int64 [batch], transitions inserted since this one.
    reuse: int32 [batch], how often each has been drawn, including this draw.
    span: uint8 [batch], environment steps from obs to next_obs.
    """

    frames: Array
    obs_index: NDArray[np.int32]
    next_index: NDArray[np.int32]
    actions: NDArray[np.int32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    weights: NDArray[np.float32]
    ids: NDArray[np.int64]
    param_version: NDArray[np.int64]
    age: NDArray[np.int64]
    reuse: NDArray[np.int32]
    span: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.actions)

    def columns(self) -> dict[str, Array]:
        """All arrays except the frames, by name."""
        return {column.name: getattr(self, column.name) for column in fields(Batch) if column.name != "frames"}
