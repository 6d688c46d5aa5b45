"""The data that roles exchange: environment specification and ended episodes; see also `coop.common.transitions`."""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

from msgspec import Meta, Struct
from numpy.typing import NDArray

from coop.common.bounded import Counter, Float32, Incarnation, Name, Share
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


class EnvSpec(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The properties of an environment that networks and tables need.

    frame_shape: shape of one stored frame: a vector, e.g. (4,) on CartPole, or a picture, (height, width) or (height,
        width, channels), e.g. (84, 84) on Atari.
    frame_dtype: "uint8", "bool" or "float32".
    stack: frames in one observation (1: the frame is the observation).
    num_actions: size of the Discrete action space.
    masks: the environment says in each state which actions are allowed.
    """

    env_id: Name
    frame_shape: Annotated[tuple[Annotated[int, Meta(ge=1, le=MAX_SIDE)], ...], Meta(min_length=1, max_length=3)]
    frame_dtype: Annotated[str, Meta(pattern="^(uint8|bool|float32)$")]
    stack: Annotated[int, Meta(ge=1, le=MAX_STACK)]
    num_actions: Annotated[int, Meta(ge=1, le=MAX_ACTIONS)]
    masks: bool = False

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
