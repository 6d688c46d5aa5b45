"""What error-driven learning does to an optimizer's steps: each beside the one that plain gradients would have made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from coop.learner.agent import Agent
from coop.learner.edl.arrays import AnyArray
from coop.learner.edl.backprop import Tape
from coop.learner.edl.feedback import FeedbackRule
from coop.learner.optimizers import make_optimizer

EVERY = 500  # updates of a network between two measurements


class PlainSteps:
    """Follows the updates of an agent that has made none yet; these stay as they would be without.

    Beside each network's optimizer there is one with running means of its own, which gets the plain gradients of the
    same batches at the same parameters.

    rows: of each measurement the number of the network's update, "cosine" and "ratio": by layer, of weights and bias
        together, the cosine of the step taken with the plain one, and its length relative to that.
    """

    def __init__(self, agent: Agent, every: int = EVERY) -> None:
        if agent.updates:
            raise ValueError("running means of plain gradients begin with the run")
        self._agent, self._every = agent, every
        self.rows: list[dict[str, Any]] = []
        for number in range(len(agent.optimizers)):
            self._follow(number)

    def _follow(self, number: int) -> None:
        network, optimizer = self._agent._networks[number], self._agent.optimizers[number]
        parameters = network.network
        plain, moved = torch.zeros_like(parameters.flat), torch.zeros_like(parameters.flat)
        views: Mapping[str, Any] = parameters.views(plain.numpy() if network.in_numpy else plain)
        network._rule = _PlainToo(network._rule, views)
        beside, step = make_optimizer(self._agent.config.learner, moved, plain), optimizer.step

        def measured(rate: float | Tensor) -> None:
            before = parameters.flat.clone()
            moved.copy_(before)
            beside.step(rate)
            step(rate)
            if beside.steps % self._every == 0:
                self.rows.append({"update": beside.steps, **self._compared(parameters.flat - before, moved - before)})

        optimizer.step = measured  # type: ignore[method-assign]

    def _compared(self, step: Tensor, plain: Tensor) -> dict[str, list[float]]:
        parts: dict[str, list[int]] = {}
        place = 0
        for name, shape in self._agent.networks[0].layout:
            size = torch.Size(shape).numel()
            parts.setdefault(name.rsplit(".", 1)[0], []).extend((place, place + size))
            place += size
        layers = [slice(min(ends), max(ends)) for ends in parts.values()]
        pairs = [(step[layer].double(), plain[layer].double()) for layer in layers]
        return {
            "cosine": [float(one @ other / (one.norm() * other.norm())) for one, other in pairs],
            "ratio": [float(one.norm() / other.norm()) for one, other in pairs],
        }


class _PlainToo(FeedbackRule[Any]):
    """The feedback of a network, which writes the plain gradients to other arrays as well."""

    def __init__(self, rule: FeedbackRule[Any], views: Mapping[str, Any]) -> None:
        super().__init__(rule.backprop, rule.feedback, rule._seed, rule._rng)
        self._plain, self._views = FeedbackRule(rule.backprop, "none"), views

    def backward(self, tape: Tape[Any], error: AnyArray, s: Any, out: Mapping[str, Any]) -> None:  # noqa: ANN401
        self._plain.backward(tape, error, 0.0, self._views)
        super().backward(tape, error, s, out)
