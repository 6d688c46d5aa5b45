"""An actor's turn, without I/O: choose actions, step emulators, record ended episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coop.actors.policy import EpsilonGreedy
from coop.common.envs.protocol import Steps, VectorEnv
from coop.common.types import Array, EpisodeEnd


@dataclass(frozen=True, slots=True)
class Turn:
    """One step of all emulators with its actions.

    actions: int32 [envs]. version: of the parameters that chose them. ended: the episodes that ended, by stream.
    """

    actions: NDArray[np.int32]
    steps: Steps
    version: int
    ended: Mapping[int, EpisodeEnd]


class Player:
    """Plays all emulators of one process with one policy.

    Args:
        epsilon: probability of a random action as a function of the run's environment steps.

    Attributes:
        steps: environment steps played by this process, over all its emulators.
    """

    def __init__(self, env: VectorEnv, policy: EpsilonGreedy, epsilon: Callable[[int], float]) -> None:
        self.steps = 0
        self._env = env
        self._policy = policy
        self._epsilon = epsilon
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, np.int64)
        self._obs: Array
        self._chosen: tuple[NDArray[np.int32], float, int]

    def begin(self) -> Array:
        """Start every emulator; return the first observations, <frame_dtype>[envs, *obs_shape]."""
        self._obs = self._env.reset()
        return self._obs

    def send(self, env_step: int, version: int) -> None:
        """Choose an action for every emulator and begin to play it; `recv` must follow.

        env_step: environment steps of the whole run so far, for epsilon. version: of the acting parameters.
        """
        epsilon = self._epsilon(env_step)
        self._play(self._policy.act(self._obs, epsilon, self._env.mask), epsilon, version)

    def replay(self, actions: NDArray[np.int32]) -> Turn:
        """Play recorded actions, int32 [envs], to bring emulators back to an earlier state."""
        self._play(actions, 0.0, 0)
        return self.recv()

    def recv(self) -> Turn:
        """Wait for the result of the actions sent last."""
        actions, epsilon, version = self._chosen
        steps = self._env.recv()
        self._obs = steps.obs
        self.steps += self._env.num_envs
        self._returns += steps.raw_rewards
        self._lengths += 1
        ended = {}
        if np.count_nonzero(steps.episode_over):
            streams = np.flatnonzero(steps.episode_over).tolist()
            ended = {stream: self._end(stream, steps, epsilon, version) for stream in streams}
        return Turn(actions, steps, version, ended)

    def _play(self, actions: NDArray[np.int32], epsilon: float, version: int) -> None:
        self._chosen = actions, epsilon, version
        self._env.send(actions)

    def _end(self, stream: int, steps: Steps, epsilon: float, version: int) -> EpisodeEnd:
        """Build a stream's episode record and reset its counters; the segment assembler sets `step_in_segment`."""
        # Diverged networks give non-finite values, which segments must not contain; the learner ends such a run.
        mask = None if steps.next_mask is None else steps.next_mask[stream]
        q1_mean, q2_mean = np.nan_to_num(self._policy.mean_values(steps.next_obs[stream], mask)).tolist()
        episode_return, length = float(self._returns[stream]), int(self._lengths[stream])
        self._returns[stream], self._lengths[stream] = 0.0, 0
        return EpisodeEnd(0, episode_return, length, epsilon, q1_mean, q2_mean, version)
