"""Catch: a paddle must catch a falling ball. The smallest pixel game that tests learning from pictures."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

CELLS = 7
CELL = 12  # pixels
SIDE = CELLS * CELL
MAX_RETURN = 1.0


class Catch(gymnasium.Env[NDArray[np.uint8], np.int64]):
    """One drop of a ball in a 7x7 grid of 12-pixel cells, seen as uint8 [84, 84].

    The ball starts in a random column of the top row and falls one cell a step; the paddle starts in the middle
    of the bottom row and moves one cell: 0 left, 1 stay, 2 right. The sixth step ends the episode with reward +1
    where the paddle is under the ball and -1 where it is not; every other reward is 0. So an episode takes 6
    steps, the maximum return is 1.0 (`MAX_RETURN`) and standing still gets -5/7.
    """

    def __init__(self) -> None:
        self.observation_space = Box(0, 255, (SIDE, SIDE), np.uint8)
        self.action_space = Discrete(3)
        self._row = self._column = self._paddle = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Drop the next ball; a seed makes all following drops repeatable."""
        super().reset(seed=seed)
        self._row, self._paddle = 0, CELLS // 2
        self._column = int(self.np_random.integers(CELLS))
        return self._picture(), {}

    def step(self, action: int | np.int64) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Move the paddle and let the ball fall one cell."""
        self._paddle = min(max(self._paddle + int(action) - 1, 0), CELLS - 1)
        self._row += 1
        landed = self._row == CELLS - 1
        caught = self._paddle == self._column
        reward = (1.0 if caught else -1.0) if landed else 0.0
        return self._picture(), reward, landed, False, {}

    def _picture(self) -> NDArray[np.uint8]:
        cells = np.zeros((CELLS, CELLS), np.uint8)
        cells[CELLS - 1, self._paddle] = 128
        cells[self._row, self._column] = 255
        return cells.repeat(CELL, axis=0).repeat(CELL, axis=1)


gymnasium.register("coop/Catch-v0", entry_point="coop.common.envs.catch:Catch")
