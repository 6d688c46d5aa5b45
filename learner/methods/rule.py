"""The learner's part of a method: its targets, its loss, extra costs, and what it does behind an update."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from coop.common.settings.config import RunConfig
from coop.learner.edl.arrays import ArrayT, chosen
from coop.learner.methods.step import Step

HOOKS = ("targets", "loss", "extra_cost", "add_gradient", "after_update")
AUTOGRAD = frozenset(("loss", "extra_cost"))


class UpdateRule:
    """What a method changes in the update; this one, of the paper's four methods, changes nothing.

    What a subclass does not define costs nothing.

    A class of its own gets the values in numpy. With `on_device = True` it gets the arrays of the networks, numpy's
    or tensors on their device, and depends on nothing but their values: a GPU then repeats recorded updates, in which
    the host has no part.

    Attributes:
        config: of the run.
        rng: the agent's generator, whose state it saves.
        passes: steps of the optimizer that one update makes with its batch.
        on_device: see above; False for a class that does not say so itself.
        hooks: names of the methods below that its class defines.
    """

    passes = 1
    on_device = True
    hooks: frozenset[str] = frozenset()

    def __init_subclass__(cls) -> None:
        """Let a class that does not know of devices keep to numpy."""
        cls.on_device = vars(cls).get("on_device", False)
        cls.hooks = frozenset(name for name in HOOKS if getattr(cls, name) is not getattr(UpdateRule, name))

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

    def targets(self, step: Step) -> Any:  # noqa: ANN401
        """The targets of the batch's Q-values, float32 [batch]: r + gamma^k V(x'), 0 in place of a terminal V(x')."""
        values = self.bootstrap(step.target_q_next, step.q_next if step.double else step.target_q_next)
        if step.value_bound is not None:
            values = values.clip(-step.value_bound, step.value_bound)
        return step.rewards + step.discounts * values

    def loss(self, step: Step, q: Tensor) -> Tensor:
        """The batch's loss in place of `learner.loss`, a tensor of one; its gradient in q goes back.

        q: Q of the trained network at obs, float32 [batch, actions]. step: in tensors, with its `targets`.
        """
        raise NotImplementedError

    def extra_cost(self, step: Step, q: Tensor) -> Tensor:
        """A cost to be added to the loss, a tensor of one; arguments as of `loss`. With it goes the feedback of s."""
        raise NotImplementedError

    def add_gradient(self, step: Step) -> None:
        """Add the gradient of a cost at other states than the batch's (`QNetwork.add_gradient`)."""

    def after_update(self, step: Step) -> None:
        """Do what the method does behind a step, for example change the target network; `QNetwork.changed` if so."""

    def metrics(self) -> dict[str, float]:
        """Columns of its own for metrics.jsonl, asked for at each row; finite numbers, with names of their own."""
        return {}

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
