"""Networks of Linear layers and ReLUs in numpy, whose calls cost a fraction of PyTorch's on the CPU."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import nn

from common.types import Array

DTYPES = (torch.float32, torch.float64)


class Dense:
    """The forward pass of such a network, over the parameters in place.

    names: prefix of the parameters' names of each layer. weights: <float>[out, in]. biases: <float>[out, 1].
    """

    def __init__(self, module: nn.Module) -> None:
        """`module` must fit (see `fits`)."""
        layers = [(name, step) for name, step in module.named_children() if isinstance(step, nn.Linear | nn.Conv2d)]
        self.names = [f"{name}." for name, _ in layers]
        self.weights: list[Array] = [step.weight.detach().flatten(1).numpy() for _, step in layers]
        self.biases: list[Array] = [step.bias.detach().numpy()[:, None] for _, step in layers if step.bias is not None]

    @staticmethod
    def fits(module: nn.Module) -> bool:
        """Whether a network is Linear, ReLU, Linear, ..., Linear with biases, in float32 or float64 on the CPU.

        No two layers may share a parameter.
        """
        steps = list(module) if type(module) is nn.Sequential else []
        kinds = [type(step) for step in steps]
        return (
            len(steps) % 2 == 1
            and kinds == ([nn.Linear, nn.ReLU] * len(steps))[: len(steps)]
            and all(isinstance(step.bias, torch.Tensor) for step in steps[::2])
            and len(list(module.parameters())) == len(steps) + 1
            and all(p.device.type == "cpu" and p.dtype in DTYPES for p in module.parameters())
        )

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
