"""The TD errors of a batch, their loss, and the output error for the backward pass; in numpy, as they are few."""

from __future__ import annotations

from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from common.types import Batch

Values = NDArray[np.float32]


class Loss(Protocol):
    """A loss of single TD errors."""

    def cost(self, errors: Values) -> Values:
        """The loss of each TD error, float32 [batch]."""

    def slope(self, errors: Values) -> Values:
        """The derivative of the loss at each TD error, float32 [batch]."""


class SquaredError:
    """1/2 e^2."""

    def cost(self, errors: Values) -> Values:
        """See `Loss`."""
        return np.float32(0.5) * errors * errors

    def slope(self, errors: Values) -> Values:
        """See `Loss`."""
        return errors


class MeanSquaredError:
    """e^2, like PyTorch's MSELoss: its slope is twice that of the squared error."""

    def cost(self, errors: Values) -> Values:
        """See `Loss`."""
        return errors * errors

    def slope(self, errors: Values) -> Values:
        """See `Loss`."""
        return np.float32(2) * errors


class Huber:
    """1/2 e^2 where |e| < 1, and |e| - 1/2 beyond: the squared error with its slope clipped to [-1, 1]."""

    def cost(self, errors: Values) -> Values:
        """See `Loss`."""
        size = np.abs(errors)
        return np.where(size < 1, np.float32(0.5) * size * size, size - np.float32(0.5))

    def slope(self, errors: Values) -> Values:
        """See `Loss`."""
        return errors.clip(-1, 1)


LOSSES: dict[str, Loss] = {"squared": SquaredError(), "mse": MeanSquaredError(), "huber": Huber()}


def td_errors(
    batch: Batch, values: Values, bootstrap: Values, gamma: float, value_bound: float | None = None
) -> Values:
    """e[a] = y[a] - (r + gamma^k (1 - terminated) V(x')) of the actions taken, float32 [batch].

    k: the steps that a transition spans, 1 except for n-step returns.

    values: y = Q(x), float32 [batch, actions]. bootstrap: V(x'), float32 [batch], clipped to +-value_bound.
    """
    if value_bound is not None:
        bootstrap = bootstrap.clip(-value_bound, value_bound)
    discounts = _powers(gamma)[batch.span] * ~batch.terminated
    errors: Values = values[np.arange(len(batch)), batch.actions] - (batch.rewards + discounts * bootstrap)
    return errors


def output_error(batch: Batch, slopes: Values, outputs: Values) -> Values:
    """The gradient of the batch's mean weighted loss with respect to the outputs, float32 [batch, actions].

    Only the entries of the actions taken are not 0.

    slopes: float32 [batch], of each transition's loss. outputs: an array of the result's shape and memory layout.
    """
    error = np.zeros_like(outputs)
    error[np.arange(len(batch)), batch.actions] = slopes * batch.weights / np.float32(len(batch))
    return error


@cache
def _powers(gamma: float) -> Values:
    """gamma^k of every span k that a transition may have, float32 [256]."""
    powers: Values = np.float32(gamma) ** np.arange(256, dtype=np.uint8)
    return powers
