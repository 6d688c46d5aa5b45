"""What a feedback rule asks of a network: one forward pass, recorded, and the products of backpropagation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Generic

import torch

from coop.common.errors import UsageError
from coop.learner.edl.arrays import ArrayT


class UnsupportedLayerError(UsageError, ValueError):
    """A layer has no meaning in these passes; the message names it."""


@dataclass(slots=True)
class Tape(Generic[ArrayT]):
    """The activations of one forward pass, for the backward passes.

    output: [batch, actions]. inputs: the input of each step, [batch, *shape], images channels last.
    """

    output: ArrayT
    inputs: list[ArrayT]

    def head(self, batch: int) -> Tape[ArrayT]:
        """The tape of the first `batch` samples."""
        return Tape(self.output[:batch], [x[:batch] for x in self.inputs])

    def output_of(self, index: int) -> ArrayT:
        """The output of step `index`: [batch, *shape]; if a ReLU follows, only its shape and sign are valid."""
        return self.inputs[index + 1] if index + 1 < len(self.inputs) else self.output


@dataclass(frozen=True, slots=True)
class Subspace:
    """The actions' directions that one layer reaches, where its T(i) [A, n] lacks rank for every input and weight.

    basis: float64 [A, k], orthonormal columns, whose span holds every T(i)'s. rank: the largest rank of T(i), at most
    k.
    """

    basis: torch.Tensor
    rank: int


class Backprop(ABC, Generic[ArrayT]):
    """The forward and backward passes of one network, in arrays of one library; it consists of steps, in order.

    names: prefix of the parameters' names of each step. parametrised: indices of the steps that feedback trains.
    """

    names: list[str]
    parametrised: list[int]

    @property
    @abstractmethod
    def output_weight(self) -> ArrayT | None:
        """The weight [actions, n] of a Linear layer whose output is the network's; None if there is none."""

    @abstractmethod
    def forward(self, x: ArrayT) -> Tape[ArrayT]:
        """Run the network on x, <float>[batch, *input]."""

    @abstractmethod
    def cotangents(self, tape: Tape[ArrayT], cotangent: ArrayT) -> Iterator[tuple[int, ArrayT]]:
        """Propagate cotangents of the output to every pre-activation: (step, [b, k, *output of step]), last first.

        cotangent: [b, k, actions], k cotangents for each sample; b is the batch, or 1 for cotangents that all samples
        share.
        """

    @abstractmethod
    def write_gradients(self, tape: Tape[ArrayT], index: int, delta: ArrayT, out: Mapping[str, ArrayT]) -> None:
        """Write the gradients of step `index`'s parameters, given delta [batch, *output] at its pre-activation."""

    def write_rest(self, tape: Tape[ArrayT], error: ArrayT, out: Mapping[str, ArrayT]) -> None:
        """Write the ordinary gradients of the parameters outside the steps; most have none.

        error: [batch, actions], at the output.
        """

    def range_of(self, index: int) -> Subspace | None:
        """The range of T of step `index`; None if some weights and inputs give it full rank."""
        return None
