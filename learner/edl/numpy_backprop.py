"""Forward and backward passes of Linear and ReLU networks in numpy, the counterpart of `TorchBackprop`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from coop.common.networks.convolution import Dense
from coop.common.types import Array
from coop.learner.edl.backprop import Backprop, Tape
from coop.learner.edl.polar import whitened


class NumpyBackprop(Backprop[Array]):
    """The products of backpropagation, like `TorchBackprop`; a step is a Linear layer with its ReLU."""

    def __init__(self, network: Dense) -> None:
        self._network = network
        self.names = network.names
        self.parametrised = list(range(len(network.weights)))

    @property
    def output_weight(self) -> Array:
        """The weight [actions, n] of the last layer."""
        return self._network.weights[-1]

    def forward(self, x: Array) -> Tape[Array]:
        """Run the network on x, <float>[batch, *input]."""
        *inputs, output = self._network.activations(x)
        return Tape(output, inputs)

    def cotangents(self, tape: Tape[Array], cotangent: Array) -> Iterator[tuple[int, Array]]:
        """As `TorchBackprop.cotangents`: (layer, cotangents [b, k, n] of its outputs)."""
        rows = cotangent
        for index in reversed(self.parametrised):
            yield index, rows
            if index:
                weight, mask = self._network.weights[index], (tape.inputs[index] > 0)[:, None]
                # One product for each k, because small products are faster.
                rows = np.matmul(rows.swapaxes(0, 1), weight).swapaxes(0, 1)
                if len(rows) == len(mask):
                    rows *= mask
                else:
                    rows = rows * mask

    def write_gradients(self, tape: Tape[Array], index: int, delta: Array, out: Mapping[str, Array]) -> None:
        """Write the gradients of layer `index`'s parameters, given delta [batch, n] at its pre-activation."""
        np.dot(delta.T, tape.inputs[index], out=out[self.names[index] + "weight"])
        np.add.reduce(delta, 0, out=out[self.names[index] + "bias"])

    @staticmethod
    def gram(t: Array) -> Array:
        """Products t t^T of each sample: [b, A, n] -> [b, A, A]."""
        products: Array = np.vecdot(t[:, :, None], t[:, None])
        return products

    @staticmethod
    def combine(weights: Array, t: Array) -> Array:
        """Sums w_1 t_1 + ... + w_A t_A of each sample: [batch, A], [batch, A, n] -> [batch, n]."""
        sums: Array = np.matmul(weights[:, None], t)[:, 0]
        return sums

    @staticmethod
    def whitened(grams: Array, e: Array) -> tuple[Array, Array | None]:
        """See `coop.learner.edl.polar.whitened`."""
        return whitened(grams, e)
