"""MeDQN of Lan, Pan, Luo and Mahmood (arXiv 2205.10868), with real states and with uniform ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from coop.common.settings.config import RunConfig
from coop.common.settings.medqn import MedqnSettings
from coop.learner.edl.arrays import AnyArray
from coop.learner.methods.rule import UpdateRule
from coop.learner.methods.step import Step
from coop.learner.qnetwork import as_float32, on_host

Bounds = NDArray[np.float32]


class Consolidation(UpdateRule):
    """Keeps the network near its target network: cost lambda * mean over states of sum_a (Q(s, a) - Q_target(s, a))^2.

    Attributes:
        low, high: float32 [*input], the smallest and the largest input seen in each dimension; empty at first.
    """

    def __init__(self, config: RunConfig, rng: np.random.Generator) -> None:
        super().__init__(config, rng)
        assert isinstance(config.method_settings, MedqnSettings)
        self.settings = config.method_settings
        self.passes = self.settings.epochs
        self.low: Bounds = np.empty(0, np.float32)
        self.high: Bounds = np.empty(0, np.float32)

    def strength(self, update: int) -> float:
        """The value of lambda in an update, counted from 0."""
        start, end = self.settings.lambda_start, self.settings.lambda_end
        return start + (end - start) * min(1.0, update / self.config.planned_updates)

    def add_gradient(self, step: Step) -> None:
        """See `UpdateRule`."""
        online, target, inputs = step.online, step.target, step.inputs
        obs = inputs[: len(inputs) // 2]
        states = obs if self.settings.states == "real" else self._draw(inputs, len(obs))
        tape = online.forward(states)
        gap = as_float32(tape.output) - target.values(states)
        online.add_gradient(tape, 2 * self.strength(step.update) / len(states) * gap)

    def _draw(self, inputs: AnyArray, count: int) -> Bounds:
        """Widen the bounds by inputs [n, *input], and draw `count` states between them."""
        seen = on_host(inputs)
        low, high = seen.min(0), seen.max(0)
        self.low, self.high = (np.minimum(self.low, low), np.maximum(self.high, high)) if self.low.size else (low, high)
        share = self.rng.random((count, *self.low.shape), np.float32)
        states: Bounds = self.low + share * (self.high - self.low)
        return states

    def state(self) -> dict[str, Any]:
        """See `UpdateRule`."""
        return {"low": torch.tensor(self.low), "high": torch.tensor(self.high)}

    def load_state(self, state: dict[str, Any]) -> None:
        """See `UpdateRule`."""
        self.low, self.high = state["low"].numpy(), state["high"].numpy()
