"""Epsilon-greedy policy over the acting network, in one forward pass for all emulators of a process."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coop.common.networks.acting import ActingNetwork
from coop.common.networks.masks import allowed, random_actions
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

    def act(self, obs: Array, epsilon: float, mask: NDArray[np.bool_] | None = None) -> NDArray[np.int32]:
        """Choose actions, int32 [envs], for observations <frame_dtype>[envs, *obs_shape].

        mask: bool [envs, actions], which actions are allowed; None: all.
        """
        actions = np.empty(len(obs), np.int32)
        random = (self._rng.random(len(obs)) < epsilon).nonzero()[0]
        if len(random) < len(obs):
            # (greedy action)
            actions[:] = allowed(self.networks[self.acting].q_values(obs, self._spec), mask).argmax(1)
        if len(random):
            among = None if mask is None else mask[random]
            actions[random] = random_actions(self._rng, len(random), self._spec.num_actions, among)
        return actions

    def mean_values(self, obs: Array, mask: NDArray[np.bool_] | None = None) -> tuple[float, float]:
        """Mean over the allowed actions, bool [actions], of Q1 and Q2 at one observation <frame_dtype>[*obs_shape]."""
        among = slice(None) if mask is None else mask
        first, second = (float(network.q_values(obs[None], self._spec)[0, among].mean()) for network in self.networks)
        return first, second
