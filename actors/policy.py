"""Epsilon-greedy policy over the acting network, in one forward pass for all emulators of a process."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coop.common.networks.acting import ActingNetwork
from coop.common.types import Array, EnvSpec


class EpsilonGreedy:
    """The two networks of a run, one of which acts.

    networks: Q1 and Q2. acting: 0 or 1.
    """

    def __init__(self, networks: tuple[ActingNetwork, ActingNetwork], spec: EnvSpec, rng: np.random.Generator) -> None:
        self.networks = networks
        self.acting = 0
        self._spec = spec
        self._rng = rng

    def act(self, obs: Array, epsilon: float) -> NDArray[np.int32]:
        """Choose actions, int32 [envs], for observations <frame_dtype>[envs, *obs_shape]."""
        actions = np.empty(len(obs), np.int32)
        random = (self._rng.random(len(obs)) < epsilon).nonzero()[0]
        if len(random) < len(obs):
            # (greedy action)
            actions[:] = self.networks[self.acting].q_values(obs, self._spec).argmax(1)
        if len(random):
            actions[random] = self._rng.integers(self._spec.num_actions, size=len(random), dtype=np.int32)
        return actions

    def mean_values(self, obs: Array) -> tuple[float, float]:
        """Mean over actions of Q1 and of Q2 at one observation <frame_dtype>[*obs_shape]."""
        first, second = (float(network.q_values(obs[None], self._spec).mean()) for network in self.networks)
        return first, second
