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

    def __init__(
        self, carts: Sequence[CartPoleEnv], lengths: NDArray[np.int64], limit: int, limit_terminal: bool = False
    ) -> None:
        """Go on from where the carts are.

        limit: steps of an episode at most, 0 for no limit; limit_terminal: whether the state there counts as terminal.
        """
        self._carts, self._limit, self._limit_terminal = list(carts), limit, limit_terminal
        self.state = np.array([cart.state for cart in carts], np.float64)
        self.obs = self.state.astype(np.float32)
        self.lengths = lengths
        self._physics = np.array([float(getattr(carts[0], name)) for name in _PHYSICS])

    @property
    def returns(self) -> NDArray[np.float64]:
        """Of the present episodes, float64 [K]."""
        return self.lengths.astype(np.float64)

    def push(
        self,
        values: NDArray[np.float32],
        chosen: NDArray[np.int64],
        actions: NDArray[np.int64],
        obs: NDArray[np.float32],
        rewards: NDArray[np.float32],
        raw_rewards: NDArray[np.float64],
        terminal: NDArray[np.bool_],
        over: NDArray[np.bool_],
    ) -> bool:
        """Play a step of each run; the arguments are those of `loops.push`. Returns whether an episode is over.

        rewards, raw_rewards: [K], written.
        """
        theta = self.state[:, 2]
        self.obs = obs
        rewards[:] = raw_rewards[:] = 1
        return loops.push(
            self.state, np.cos(theta), np.sin(theta), values, chosen, self._physics, self._limit, self._limit_terminal,
            self.lengths, actions, obs, terminal, over,
        )  # fmt: skip

    def restart(self, k: int) -> None:
        """Begin run k's next episode."""
        self.obs = self.obs.copy()  # the last observation of the episode stays what it was
        self.obs[k], _ = self._carts[k].reset()
        self.state[k] = self._carts[k].state
        self.lengths[k] = 0

    def kept(self, runs: NDArray[np.intp]) -> Carts:
        """The carts of these runs alone."""
        carts = [self._carts[k] for k in runs]
        found = Carts(carts, self.lengths[runs], self._limit, self._limit_terminal)
        found.state, found.obs = self.state[runs], self.obs[runs]
        return found
