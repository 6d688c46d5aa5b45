"""Corridor: walk to its end. Its optimal action values are known, which a learner can be compared with."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

CELLS = 5
LEFT, RIGHT = 0, 1


class Corridor(gymnasium.Env[NDArray[np.float32], np.int64]):
    """Five cells in a row; an observation is float32 [5], 1 at the walker's cell and 0 elsewhere.

    An episode begins in a random cell. Action 0 goes left, and stays in the first cell; action 1 goes right. To
    step out at the right end gives reward 1 and ends the episode; every other reward is 0.
    """

    def __init__(self) -> None:
        self.observation_space = Box(0.0, 1.0, (CELLS,), np.float32)
        self.action_space = Discrete(2)
        self._cell = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin in a random cell; a seed makes all following episodes repeatable."""
        super().reset(seed=seed)
        self._cell = int(self.np_random.integers(CELLS))
        return self._observation(), {}

    def step(self, action: int | np.int64) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Go one cell to the left or to the right."""
        if action == RIGHT and self._cell == CELLS - 1:
            return self._observation(), 1.0, True, False, {}
        self._cell = self._cell + 1 if action == RIGHT else max(0, self._cell - 1)
        return self._observation(), 0.0, False, False, {}

    def _observation(self) -> NDArray[np.float32]:
        observation = np.zeros(CELLS, np.float32)
        observation[self._cell] = 1.0
        return observation


def optimal_values(gamma: float) -> NDArray[np.float64]:
    """Q*(cell, action), float64 [5, 2]: right reaches the end in CELLS - cell steps; left wastes a step first."""
    right = gamma ** np.arange(CELLS - 1, -1, -1.0)
    left = gamma * np.concatenate((right[:1], right[:-1]))
    return np.stack((left, right), axis=1)


gymnasium.register("test/Corridor-v0", entry_point="corridor:Corridor", max_episode_steps=50)
