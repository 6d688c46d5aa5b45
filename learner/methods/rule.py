"""The learner's part of a method: the values that targets bootstrap from, and an extra cost."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.settings.config import RunConfig
from learner.edl.arrays import AnyArray
from learner.losses import Values
from learner.qnetwork import QNetwork


class Rule:
    """What a method changes in the update; this one, of the paper's four methods, changes nothing.

    Attributes:
        config: of the run.
        rng: the agent's generator, whose state it saves.
        passes: steps of the optimizer that one update makes with its batch.
    """

    passes = 1

    def __init__(self, config: RunConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.rng = rng

    def bootstrap(self, next_values: Values, preferred: Values) -> Values:
        """The value of each next state for its target, float32 [batch]: that of the preferred action.

        next_values: Q_target(x'), float32 [batch, actions]. preferred: float32 [batch, actions], the values by which
        the next action is chosen: the trained network's with `learner.double`, or `next_values`.
        """
        best: Values = next_values[np.arange(len(next_values)), preferred.argmax(1)]
        return best

    def add_cost(self, online: QNetwork, target: QNetwork, inputs: AnyArray, update: int) -> None:
        """Add the gradient of the extra cost to that of the TD errors (`QNetwork.add_gradient`).

        inputs: <float>[2 batch, *input], the networks' input for obs and then for next_obs. update: updates done.
        """

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
