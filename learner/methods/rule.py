"""The learner's part of a method: the values that targets bootstrap from, and an extra cost."""

from __future__ import annotations

from typing import Any

import numpy as np

from coop.common.settings.config import RunConfig
from coop.learner.edl.arrays import AnyArray, ArrayT, chosen
from coop.learner.qnetwork import QNetwork


class UpdateRule:
    """What a method changes in the update; this one, of the paper's four methods, changes nothing.

    A class of its own gets the values in numpy. With `on_device = True` it gets the arrays of the networks, numpy's
    or tensors on their device, and depends on nothing but their values: a GPU then repeats recorded updates, in which
    the host has no part.

    Attributes:
        config: of the run.
        rng: the agent's generator, whose state it saves.
        passes: steps of the optimizer that one update makes with its batch.
        on_device: see above; False for a class that does not say so itself.
    """

    passes = 1
    on_device = True

    def __init_subclass__(cls) -> None:
        """Let a class that does not know of devices keep to numpy."""
        cls.on_device = vars(cls).get("on_device", False)

    def __init__(self, config: RunConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.rng = rng

    def bootstrap(self, next_values: ArrayT, preferred: ArrayT) -> ArrayT:
        """The value of each next state for its target, float32 [batch]: that of the preferred action.

        next_values: Q_target(x'), float32 [batch, actions]. preferred: float32 [batch, actions], the values by which
        the next action is chosen: the trained network's with `learner.double`, or `next_values`.
        """
        # (double targets)
        return chosen(next_values, preferred.argmax(1))

    def add_cost(self, online: QNetwork, target: QNetwork, inputs: AnyArray, update: int) -> None:
        """Add the gradient of the extra cost to that of the TD errors (`QNetwork.add_gradient`).

        inputs: <float>[2 batch, *input], the networks' input for obs and then for next_obs. update: updates done.
        """

    def after_update(self, online: QNetwork, target: QNetwork) -> None:
        """Do what the method does behind an update, for example move the target network; `QNetwork.changed` if so."""

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
