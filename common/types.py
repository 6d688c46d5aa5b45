"""The data that roles exchange: environment specification, segments of experience and batches."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_NOT_GIVEN: NDArray[np.uint8] = np.empty(0, np.uint8)


@dataclass(frozen=True, slots=True)
class EnvSpec:
    """What a network and a table must know of an environment.

    frame_shape: shape of one stored frame, e.g. (84, 84) on Atari, (4,) on CartPole.
    frame_dtype: "uint8" or "float32".
    stack: frames that make one observation (1: the frame is the observation).
    num_actions: size of the Discrete action space.
    """

    env_id: str
    frame_shape: tuple[int, ...]
    frame_dtype: str
    stack: int
    num_actions: int

    @property
    def obs_shape(self) -> tuple[int, ...]:
        """Shape of one observation: (stack, *frame_shape), or frame_shape where nothing is stacked."""
        return self.frame_shape if self.stack == 1 else (self.stack, *self.frame_shape)


@dataclass(frozen=True, slots=True)
class EpisodeEnd:
    """One finished episode, told by the actor inside the segment that ends it.

    step_in_segment: index of the episode's last step in its segment.
    episode_return: sum of unclipped rewards. length: agent decisions.
    q1_mean, q2_mean: mean over actions of Q1 and Q2 at the last observation.
    """

    step_in_segment: int
    episode_return: float
    length: int
    epsilon: float
    q1_mean: float
    q2_mean: float
    param_version: int


@dataclass(frozen=True, slots=True)
class Segment:
    """Transitions that begin with consecutive steps of one emulator stream, as an actor sends them.

    frames: <frame_dtype>[n_frames, *frame_shape], each frame once.
    obs_index, next_index: int32 [steps, stack], rows of `frames` that make obs and next_obs (oldest first).
    actions: int32 [steps]. rewards: float32 [steps], n-step returns. terminated: bool [steps].
    param_version: int64 [steps], the version of the parameters that chose each action.
    span: uint8 [steps], environment steps from obs to next_obs; 1 each where it is not given.
    carried: how many leading frames repeat, bit for bit, the last frames of this stream's previous segment
        (sequence numbers count per stream, so that is `sequence - 1`); a table that still holds those
        frames keeps one copy. 0 at the start of a stream.
    acked: transitions of this incarnation that had been acknowledged when this segment was sent first.
    """

    incarnation: int
    stream: int
    sequence: int
    frames: Array
    obs_index: NDArray[np.int32]
    next_index: NDArray[np.int32]
    actions: NDArray[np.int32]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    param_version: NDArray[np.int64]
    span: NDArray[np.uint8] = field(default_factory=lambda: _NOT_GIVEN)
    carried: int = 0
    acked: int = 0
    episodes: tuple[EpisodeEnd, ...] = field(default=())

    def __post_init__(self) -> None:
        """Let each transition span one step where nothing else was said."""
        _default_span(self)

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
    ids: int64 [batch], the number of each transition in order of insertion, from 0 (a priority update names it).
    param_version: int64 [batch], version of the parameters that acted.
    age: int64 [batch], transitions inserted since this one.
    reuse: int32 [batch], how often each had been drawn, this draw included.
    span: uint8 [batch], environment steps from obs to next_obs; 1 each where it is not given.
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
    span: NDArray[np.uint8] = field(default_factory=lambda: _NOT_GIVEN)

    def __post_init__(self) -> None:
        """Let each transition span one step where nothing else was said."""
        _default_span(self)

    def __len__(self) -> int:
        return len(self.actions)

    def columns(self) -> dict[str, Array]:
        """Everything but the frames, by name."""
        return {column.name: getattr(self, column.name) for column in fields(self) if column.name != "frames"}


def _default_span(transitions: Segment | Batch) -> None:
    """What was recorded before transitions could span several steps does not say that they span one."""
    if transitions.span is _NOT_GIVEN:
        object.__setattr__(transitions, "span", np.ones(len(transitions.actions), np.uint8))
