"""The forward pass of Linear layers and ReLUs in numpy, whose calls cost a fraction of PyTorch's on the CPU."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from coop.common.types import Array


class DenseForward:
    """The forward pass of such a network, over the parameters in place.

    names: prefix of the parameters' names of each layer. weights: <float>[out, in]. biases: <float>[out, 1].
    """

    def __init__(self, names: Sequence[str], weights: Sequence[Array], biases: Sequence[Array]) -> None:
        self.names = list(names)
        self.weights = list(weights)
        self.biases = list(biases)

    def __call__(self, x: Array) -> Array:
        """<float>[batch, *input] -> [batch, actions]."""
        *_, output = self._columns(x)
        return output.T

    def activations(self, x: Array) -> list[Array]:
        """x, the output of each ReLU, and the network's output: <float>[batch, n] each."""
        return [x, *(np.ascontiguousarray(column.T) for column in self._columns(x))]

    def _columns(self, x: Array) -> Iterator[Array]:
        """Yield each ReLU's and the network's output: [n, batch], a layout in which products take half the time."""
        column = x.T
        last = len(self.weights) - 1
        with np.errstate(over="ignore", invalid="ignore"):  # of diverging networks, as in PyTorch
            for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
                column = weight.dot(column)
                column += bias
                if index < last:
                    np.maximum(column, 0, out=column)
                yield column
