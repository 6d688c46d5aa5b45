"""What a method's rule sees of an update: the batch, both networks, and their values."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from coop.common.networks.masks import allowed
from coop.common.transitions import Batch
from coop.learner.given import Given
from coop.learner.qnetwork import QNetwork, on_host


class Step:
    """One step of the optimizer, as a rule sees it. Values are computed when they are first asked for, and kept.

    In an environment with action masks, the values of actions that are not allowed are `LEAST`, in `q`, `q_next`,
    `target_q` and `target_q_next`; those that `online` and `target` compute are as they are.

    Arrays are numpy's for a rule that does not say `on_device`, tensors in `loss` and `extra_cost`, and otherwise those
    of the networks. Those of `online` and `target` themselves are always the networks' own.

    Attributes:
        online, target: the network that is trained, and the other one: its copy, or the second network.
        batch: as drawn, in numpy: ids, age, reuse, terminated and all others; None in updates that a GPU repeats.
        inputs: <float>[2 batch, *input], the networks' input for obs and then for next_obs, in the networks' arrays.
        update: updates done before.
        double: whether the trained network chooses the actions of next states (`learner.double`).
        value_bound: the largest |value of a next state| that `learner.reward_bound` allows, or None.
        targets: float32 [batch], once they are known.
    """

    def __init__(
        self,
        online: QNetwork,
        target: QNetwork,
        given: Given,
        batch: Batch | None,
        update: int,
        give: Callable[[Any], Any],
        inputs: Any = None,  # noqa: ANN401 (arrays of either library, as all below)
    ) -> None:
        """give: converts the networks' arrays to those that the rule gets. inputs: if they are known already."""
        self.online, self.target, self.batch, self.update = online, target, batch, update
        self._given = given
        self._give = give
        self.inputs = online.inputs(given.frames, given.index) if inputs is None else inputs
        self.double, self.value_bound = online.double, online.value_bound
        self.targets: Any = None

    @property
    def actions(self) -> Any:  # noqa: ANN401
        """The actions taken, int64 [batch]."""
        return self._give(self._given.columns.actions)

    @property
    def rewards(self) -> Any:  # noqa: ANN401
        """The rewards, n-step returns if `replay.n_step` is above 1: float32 [batch]."""
        return self._give(self._given.columns.rewards)

    @property
    def discounts(self) -> Any:  # noqa: ANN401
        """gamma^k of the k steps that a transition spans, 0 if its next state is terminal: float32 [batch]."""
        return self._give(self._given.columns.discounts)

    @property
    def weights(self) -> Any:  # noqa: ANN401
        """Weights of importance sampling, float32 [batch]."""
        return self._give(self._given.columns.weights)

    @property
    def mask(self) -> Any:  # noqa: ANN401
        """The actions allowed at obs, bool [batch, actions]; None in an environment without masks."""
        return self._maybe(self._given.columns.mask)

    @property
    def next_mask(self) -> Any:  # noqa: ANN401
        """The actions allowed at next_obs, as `mask`."""
        return self._maybe(self._given.columns.next_mask)

    @cached_property
    def q(self) -> Any:  # noqa: ANN401
        """Q of the trained network at obs, float32 [batch, actions]."""
        return self._values(self.online, 0)

    @cached_property
    def q_next(self) -> Any:  # noqa: ANN401
        """Q of the trained network at next_obs, float32 [batch, actions]."""
        return self._values(self.online, 1)

    @cached_property
    def target_q(self) -> Any:  # noqa: ANN401
        """Q of the target network at obs, float32 [batch, actions]."""
        return self._values(self.target, 0)

    @cached_property
    def target_q_next(self) -> Any:  # noqa: ANN401
        """Q of the target network at next_obs, float32 [batch, actions]."""
        return self._values(self.target, 1)

    def know(self, **values: Any) -> None:  # noqa: ANN401
        """Note values that are computed already, in the networks' arrays."""
        for name, value in values.items():
            self.__dict__[name] = self._give(value)

    def in_tensors(self) -> Step:
        """This step in tensors, of which gradients can be taken."""
        give = _outside_inference
        step = Step(self.online, self.target, self._given, self.batch, self.update, give, self.inputs)
        step.targets = give(self.targets)
        return step

    def _maybe(self, mask: Any) -> Any:  # noqa: ANN401
        return None if mask is None else self._give(mask)

    def _values(self, network: QNetwork, half: int) -> Any:  # noqa: ANN401
        """Q of a network at obs (0) or next_obs (1), float32 [batch, actions]."""
        size, held = len(self.inputs) // 2, self._given.columns
        values = network.values(self.inputs[half * size : (half + 1) * size])
        return self._give(allowed(values, (held.mask, held.next_mask)[half]))


def slope_of(cost: Callable[[Step, Tensor], Tensor], step: Step, values: Any) -> Tensor:  # noqa: ANN401
    """The gradient of a cost of the Q-values at obs, by autograd: float32 [batch, actions].

    values: the Q-values, of either library.
    """
    with torch.inference_mode(mode=False), torch.enable_grad():
        q = _outside_inference(values).requires_grad_()
        (slope,) = torch.autograd.grad(cost(step.in_tensors(), q), q)
    return slope


def to_host(values: Any) -> Any:  # noqa: ANN401
    """An array of either library as numpy's."""
    whole = isinstance(values, Tensor) and not values.is_floating_point()
    return values.cpu().numpy() if whole else on_host(values)


def _outside_inference(values: Any) -> Tensor:  # noqa: ANN401
    with torch.inference_mode(mode=False):
        return torch.as_tensor(values).clone()
