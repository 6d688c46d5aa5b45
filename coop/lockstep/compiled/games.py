"""The emulators of K lockstep runs, each stepped as its run would step it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coop.common.envs.protocol import VectorEnv
from coop.common.types import Array
from coop.lockstep.compiled.tables import Packing


class Games:
    """One emulator of each run.

    Attributes:
        obs: the present observations, rows as `Packing` has them, [K, width]. returns: float64 [K], lengths: int64 [K],
        of the present episodes.
    """

    def __init__(
        self, envs: Sequence[VectorEnv], obs: Array, returns: NDArray[np.float64], lengths: NDArray[np.int64]
    ) -> None:
        """Go on from where the emulators are; the arrays are written."""
        self._envs, self._packing = list(envs), Packing(envs[0].spec)
        self.obs, self.returns, self.lengths = obs, returns, lengths
        self._begun = list(obs)

    def push(
        self,
        values: NDArray[np.float32],
        chosen: NDArray[np.int64],
        actions: NDArray[np.int64],
        obs: Array,
        rewards: NDArray[np.float32],
        raw_rewards: NDArray[np.float64],
        terminal: NDArray[np.bool_],
        over: NDArray[np.bool_],
    ) -> bool:
        """Play a step of each run; returns whether an episode is over.

        values: float32 [K, actions]. chosen: int64 [K], -1: the greedy action. All others are written: actions: int64
        [K]; obs: [K, width]; rewards, to learn from, raw_rewards, terminal, over: [K].
        """
        for k, env in enumerate(self._envs):
            actions[k] = chosen[k] if chosen[k] >= 0 else values[k].argmax()
            steps = env.step(actions[k : k + 1].astype(np.int32))
            obs[k] = self._packing.rows(steps.next_obs)[0]
            rewards[k], raw_rewards[k] = steps.rewards[0], steps.raw_rewards[0]
            terminal[k], over[k] = steps.terminated[0], steps.episode_over[0]
            if over[k]:
                self._begun[k] = self._packing.rows(steps.obs)[0]
        self.obs = obs
        self.returns += raw_rewards
        self.lengths += 1
        return bool(over.any())

    def restart(self, k: int) -> None:
        """Begin run k's next episode."""
        self.obs = self.obs.copy()  # the last observation of the episode stays what it was
        self.obs[k] = self._begun[k]
        self.returns[k] = self.lengths[k] = 0

    def kept(self, runs: NDArray[np.intp]) -> Games:
        """The games of these runs alone."""
        return Games([self._envs[k] for k in runs], self.obs[runs], self.returns[runs], self.lengths[runs])
