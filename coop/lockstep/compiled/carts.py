"""CartPole of K lockstep runs: gymnasium's arithmetic, operation by operation, and its own random starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from numpy.typing import NDArray

from coop.common.envs.gymnasium_env import GymnasiumEnv
from coop.common.envs.protocol import VectorEnv
from coop.lockstep.compiled import loops

_PHYSICS = (
    "gravity", "masspole", "total_mass", "length", "polemass_length", "force_mag", "tau", "x_threshold",
    "theta_threshold_radians",
)  # fmt: skip


def cart_of(env: VectorEnv) -> tuple[CartPoleEnv, int]:
    """The CartPole behind a run's environment, and the steps of an episode at most.

    Raises:
        TypeError: it is another environment; `why_not` tells.
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
        cart = self._carts[0]
        self._physics = np.array([float(getattr(cart, name)) for name in _PHYSICS])

    def move(self, actions: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Play actions [K]; return which poles fell, and which episodes are over: bool [K] each."""
        before, theta = self.state, self.state[:, 2]
        self.state, self.obs = np.empty_like(before), np.empty_like(self.obs)
        fell, over = np.empty((2, len(before)), np.bool_)
        loops.pushed(
            before, np.cos(theta), np.sin(theta), actions, self._physics, self._limit,
            self.lengths, self.state, self.obs, fell, over,
        )  # fmt: skip
        return fell, over

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
