"""The TD errors of a batch, their loss, and the output error for the backward pass, in the arrays of the network."""

from __future__ import annotations

from functools import cache
from typing import Any, Generic, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from coop.common.transitions import Batch
from coop.learner.edl.arrays import ArrayT, chosen, namespace, placed

Values = NDArray[np.float32]


class Loss(Protocol):
    """A loss of single TD errors."""

    def cost(self, errors: ArrayT) -> ArrayT:
        """The loss of each TD error, float32 [batch]."""

    def slope(self, errors: ArrayT) -> ArrayT:
        """The derivative of the loss at each TD error, float32 [batch]."""


class SquaredError:
    """1/2 e^2."""

    def cost(self, errors: ArrayT) -> ArrayT:
        """See `Loss`."""
        costs: ArrayT = 0.5 * errors * errors
        return costs

    def slope(self, errors: ArrayT) -> ArrayT:
        """See `Loss`."""
        return errors


class MeanSquaredError:
    """e^2, like PyTorch's MSELoss: its slope is twice that of the squared error."""

    def cost(self, errors: ArrayT) -> ArrayT:
        """See `Loss`."""
        costs: ArrayT = errors * errors
        return costs

    def slope(self, errors: ArrayT) -> ArrayT:
        """See `Loss`."""
        slopes: ArrayT = 2 * errors
        return slopes


class Huber:
    """1/2 e^2 where |e| < 1, and |e| - 1/2 beyond: the squared error with its slope clipped to [-1, 1]."""

    def cost(self, errors: ArrayT) -> ArrayT:
        """See `Loss`."""
        size = abs(errors)
        return namespace(errors).where(size < 1, 0.5 * size * size, size - 0.5)

    def slope(self, errors: ArrayT) -> ArrayT:
        """See `Loss`."""
        return errors.clip(-1, 1)


LOSSES: dict[str, Loss] = {"squared": SquaredError(), "mse": MeanSquaredError(), "huber": Huber()}


class BatchColumns(NamedTuple, Generic[ArrayT]):
    """What the loss needs of a batch's transitions, in arrays of one library.

    actions: int64 [batch]. rewards: float32 [batch]. discounts: float32 [batch], gamma^k of the k steps that a
    transition spans, 0 for a terminal next state. weights: float32 [batch], of importance sampling.
    mask, next_mask: bool [batch, actions], the actions allowed at obs and at next_obs, or None.
    """

    actions: ArrayT
    rewards: ArrayT
    discounts: ArrayT
    weights: ArrayT
    mask: ArrayT | None = None
    next_mask: ArrayT | None = None


def columns(batch: Batch, gamma: float) -> BatchColumns[NDArray[Any]]:
    """The columns of a batch, in numpy."""
    discounts = _powers(gamma)[batch.span] * ~batch.terminated
    return BatchColumns(
        batch.actions.astype(np.int64), batch.rewards, discounts, batch.weights, batch.mask, batch.next_mask
    )


def td_errors(
    batch: BatchColumns[ArrayT], values: ArrayT, bootstrap: ArrayT, value_bound: float | None = None
) -> ArrayT:
    """e[a] = y[a] - (r + gamma^k (1 - terminated) V(x')) of the actions taken, float32 [batch].

    values: y = Q(x), float32 [batch, actions]. bootstrap: V(x'), float32 [batch], clipped to +-value_bound.
    """
    if value_bound is not None:
        # (bound of targets)
        bootstrap = bootstrap.clip(-value_bound, value_bound)
    # (td error)
    errors: ArrayT = chosen(values, batch.actions) - (batch.rewards + batch.discounts * bootstrap)
    return errors


def output_error(batch: BatchColumns[ArrayT], slopes: ArrayT, outputs: ArrayT) -> ArrayT:
    """The gradient of the batch's mean weighted loss with respect to the outputs, float32 [batch, actions].

    Only the entries of the actions taken are not 0.

    slopes: float32 [batch], of each transition's loss. outputs: an array of the result's shape and memory layout.
    """
    # (cotangent of the output)
    return placed(slopes * batch.weights / len(slopes), batch.actions, outputs)


@cache
def _powers(gamma: float) -> Values:
    """gamma^k of every span k that a transition may have, float32 [256]."""
    powers: Values = np.float32(gamma) ** np.arange(256, dtype=np.uint8)
    return powers
