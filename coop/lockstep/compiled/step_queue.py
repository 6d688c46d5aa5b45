"""The steps that tables do not hold yet: those since a segment's end, and those whose transitions are not complete."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop.actors.returns import n_step_returns
from coop.common.types import Array
from coop.lockstep.compiled.tables import Tables


class PlayedStep(NamedTuple):
    """A step of K runs. obs, next_obs: rows [K, width]; all others but `version` [K]."""

    obs: Array
    next_obs: Array
    actions: NDArray[np.int64]
    rewards: NDArray[np.float32]
    terminal: NDArray[np.bool_]
    over: NDArray[np.bool_]
    version: int


class StepQueue:
    """Steps on their way to the tables, which get them at the end of each segment, as from `SegmentAssembler`.

    Returns over several steps are those of one run: where an episode ends decides how many transitions are complete.
    """

    def __init__(self, n_step: int, gamma: float) -> None:
        self._n_step, self._gamma = n_step, gamma
        self._steps: list[PlayedStep] = []

    def add(self, step: PlayedStep) -> None:
        """Keep a step, whose arrays must not be written again."""
        self._steps.append(step)

    def insert(self, tables: Tables, rows: NDArray[np.int64]) -> None:
        """End a segment; rows: int64 [steps, K], where the last steps go, unless returns span several."""
        if self._n_step == 1:
            for row, step in zip(rows[-len(self._steps) :], self._steps, strict=True):
                tables.insert(row, step.obs, step.next_obs, step.actions, step.rewards, step.terminal, step.version, 1)
            self._steps = []
            return
        rewards = np.array([step.rewards for step in self._steps])
        ends = np.array([step.terminal | step.over for step in self._steps])
        last, returns = n_step_returns(rewards, ends, self._n_step, self._gamma)
        complete = int(last[:, 0].searchsorted(len(self._steps)))
        for i, row in enumerate(tables.rows(0, tables.inserted, complete)):
            first, final = self._steps[i], self._steps[last[i, 0]]
            tables.insert(
                np.array([row]), first.obs, final.next_obs, first.actions, returns[i], final.terminal, first.version,
                int(last[i, 0]) - i + 1,
            )  # fmt: skip
        self._steps = self._steps[complete:]
