"""CartPole of K lockstep runs: gymnasium's arithmetic, operation by operation, and its own random starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from numpy.typing import NDArray

from coop.common.envs.gymnasium_env import GymnasiumEnv
from coop.common.envs.protocol import VectorEnv
from coop.studies.stacked.cartpole import FORCE, GRAVITY, HALF_LENGTH, MAX_ANGLE, MAX_X, POLE_MASS, TAU, TOTAL_MASS

Doubles = NDArray[np.float64]


def cart_of(env: VectorEnv) -> tuple[CartPoleEnv, int]:
    """The CartPole behind a run's environment, and the steps of an episode at most.

    Raises:
        TypeError: it is another environment; `eligible.why_not` tells.
    """
    found = env._envs[0]._env.unwrapped if isinstance(env, GymnasiumEnv) else env
    if not isinstance(env, GymnasiumEnv) or type(found) is not CartPoleEnv:
        raise TypeError(f"{type(found).__name__}: not gymnasium's CartPole")
    return found, env._limit


class Carts:
    """The carts of K runs.

    Attributes:
        state: float64 [K, 4]. obs: float32 [K, 4]. lengths: int64 [K], steps of the present episodes.
    """

    def __init__(self, carts: Sequence[CartPoleEnv], lengths: Sequence[int], limit: int) -> None:
        """Go on from where the carts are; limit: steps of an episode at most, 0 for no limit."""
        self._carts, self._limit = list(carts), limit
        self.state = np.array([cart.state for cart in carts], np.float64)
        self.obs = self.state.astype(np.float32)
        self.lengths = np.array(lengths, np.int64)

    def move(self, actions: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Play actions [K]; return which poles fell, and which episodes are over: bool [K] each."""
        x, x_dot, theta, theta_dot = self.state.T
        force = np.where(actions == 1, FORCE, -FORCE)
        cos, sin = np.cos(theta), np.sin(theta)
        length = POLE_MASS * HALF_LENGTH
        temp = (force + length * np.square(theta_dot) * sin) / TOTAL_MASS
        theta_acc = (GRAVITY * sin - cos * temp) / (
            HALF_LENGTH * (4.0 / 3.0 - POLE_MASS * np.square(cos) / TOTAL_MASS)
        )  # fmt: skip
        x_acc = temp - length * theta_acc * cos / TOTAL_MASS
        state = np.empty_like(self.state)
        np.add(x, TAU * x_dot, out=state[:, 0])
        np.add(x_dot, TAU * x_acc, out=state[:, 1])
        np.add(theta, TAU * theta_dot, out=state[:, 2])
        np.add(theta_dot, TAU * theta_acc, out=state[:, 3])
        self.state, self.obs = state, state.astype(np.float32)
        self.lengths += 1
        fell = (np.abs(state[:, 0]) > MAX_X) | (np.abs(state[:, 2]) > MAX_ANGLE)
        return fell, fell | (self.lengths == self._limit)

    def restart(self, k: int) -> None:
        """Begin run k's next episode."""
        self.obs[k], _ = self._carts[k].reset()
        self.state[k] = self._carts[k].state
        self.lengths[k] = 0

    def kept(self, runs: NDArray[np.intp]) -> Carts:
        """The carts of these runs alone."""
        found = Carts([self._carts[k] for k in runs], self.lengths[runs].tolist(), self._limit)
        found.state, found.obs = self.state[runs], self.obs[runs]
        return found
