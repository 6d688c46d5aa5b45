"""The environment interface: a batch of emulators that step together and report exactly how episodes end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coop.common.types import Array, EnvSpec


@dataclass(frozen=True, slots=True)
class Steps:
    """One step of every emulator. Callers must not write into the arrays; later calls do not reuse them.

    obs: <frame_dtype>[envs, *obs_shape], the next observation to act on (of the new episode if one began).
    next_obs: <frame_dtype>[envs, *obs_shape], the result of the step; the same object as `obs` if nothing restarted.
    mask, next_mask: bool [envs, actions], the actions that were allowed in the step, and those allowed at `next_obs`;
        None in an environment without masks.
    rewards: float32 [envs], for learning. raw_rewards: float64 [envs], unclipped, for reported returns.
    terminated: bool [envs], for learning: the next state has no value. A truncated step is not terminal.
    restarted: bool [envs], the emulator was reset, so obs does not continue next_obs.
    episode_over: bool [envs], the reported (full-game) episode ended.
    """

    obs: Array
    next_obs: Array
    rewards: NDArray[np.float32]
    raw_rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    restarted: NDArray[np.bool_]
    episode_over: NDArray[np.bool_]
    mask: NDArray[np.bool_] | None = None
    next_mask: NDArray[np.bool_] | None = None


class VectorEnv(Protocol):
    """`num_envs` emulators that step together and reset themselves.

    mask: bool [envs, actions], the actions allowed now, at the observations of the last `reset` or `recv`; None unless
        `spec.masks`. Never written to again.
    """

    spec: EnvSpec
    num_envs: int
    mask: NDArray[np.bool_] | None

    def reset(self) -> Array:
        """Start every emulator from its seed: <frame_dtype>[envs, *obs_shape]."""

    def send(self, actions: NDArray[np.int32]) -> None:
        """Begin to play one action, int32 [envs] in 0..num_actions-1, in every emulator; `recv` must follow."""

    def recv(self) -> Steps:
        """Wait for the result of the actions sent last."""

    def step(self, actions: NDArray[np.int32]) -> Steps:
        """`send`, then `recv`."""

    def close(self) -> None:
        """Free the emulators."""


class FilmedEnv(VectorEnv, Protocol):
    """One emulator that also shows pictures for people.

    pictures_per_s: at which the game goes at its usual speed.
    """

    pictures_per_s: float

    def picture(self) -> NDArray[np.uint8]:
        """What there is to see of the present state: uint8 [height, width, 3]."""
