"""Forward and backward passes of one convolution and Linear layers behind it: matrix products over arrays of numpy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import torch

from coop.common.networks.convolution import product
from coop.common.types import Array
from coop.learner.edl.backprop import Tape
from coop.learner.edl.numpy_backprop import NumpyBackprop


class ConvolutionBackprop(NumpyBackprop):
    """The products of backpropagation for a `ConvolutionNetwork`; the outputs of every step are [batch, n].

    The convolution comes first, so nothing is propagated through it. The tape holds `ConvolutionNetwork.activations`.
    """

    def cotangents(self, tape: Tape[Array], cotangent: Array) -> Iterator[tuple[int, Array]]:
        """As `TorchBackprop.cotangents`: (layer, cotangents [b, k, n] of its outputs)."""
        rows = cotangent
        for index in reversed(self.parametrised):
            yield index, rows
            if index == 0:
                return
            weight, h = self._network.weights[index], tape.inputs[index]
            if rows.shape[1] == 1:
                rows = self._muted(np.dot(weight.T, rows[:, 0].T), h.T).T[:, None]
            else:  # samples one after another, as Gram matrices read them
                b, k, n = rows.shape
                rows = self._muted_rows(product(rows.swapaxes(0, 1).reshape(k * b, n), weight).reshape(k, b, -1), h)
                rows = rows.swapaxes(0, 1)

    @staticmethod
    def _muted(column: Array, h: Array) -> Array:
        """Column * (h > 0), [n, batch] each; may overwrite `column`."""
        muted: Array = column * (h > 0)
        return muted

    @staticmethod
    def _muted_rows(rows: Array, h: Array) -> Array:
        """Rows [k, batch or 1, n] * (h > 0), h [batch, n], with the batch last in memory; may overwrite `rows`."""
        mask = np.ascontiguousarray(h > 0).astype(h.dtype)
        muted: Array = np.multiply(rows, mask, out=rows) if rows.shape[1] == len(mask) else rows * mask
        return muted

    @staticmethod
    def _turned(delta: Array) -> Array:
        """Cotangents [batch, n] with the batch last in memory: [n, batch], contiguous."""
        return np.ascontiguousarray(delta.T)

    def write_gradients(self, tape: Tape[Array], index: int, delta: Array, out: Mapping[str, Array]) -> None:
        """Write the gradients of layer `index`'s parameters, given delta [batch, n] at its pre-activation."""
        weight, bias = (out[self.names[index] + kind] for kind in ("weight", "bias"))
        h = tape.inputs[index]
        if index:
            product(delta.T, h, weight)
            np.add.reduce(delta, 0, out=bias)
        else:
            inputs = h.shape[2]
            gradient = product(h.T.reshape(inputs, -1), self._turned(delta).reshape(len(bias), -1).T)
            weight.reshape(len(bias), -1)[...] = gradient[:-1].T
            bias[...] = gradient[-1]

    @staticmethod
    def gram(t: Array) -> Array:
        """Products t t^T of each sample: [b, A, n] -> [b, A, A]."""
        rows = torch.from_numpy(t)
        return torch.bmm(rows, rows.mT).numpy()
