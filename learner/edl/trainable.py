"""A network for training: flat parameters, their gradient, and the forward and backward passes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from coop.common.networks.convolution import ConvolutionNetwork, Dense
from coop.common.networks.network import FlatNetwork
from coop.learner.edl.arrays import AnyArray, convert_like
from coop.learner.edl.backprop import Backprop
from coop.learner.edl.convolution import ConvolutionBackprop
from coop.learner.edl.layers import make_backprop
from coop.learner.edl.numpy_backprop import NumpyBackprop


class Trainable:
    """The network's own parameters and their gradient, with passes over tensors or, with `in_numpy`, numpy arrays.

    theta, gradient: <float>[P], in the order of the network's layout, for the optimizer; of numpy for small networks.
    gradients: name -> view of `gradient` in the shape of the parameter, of the library of the passes.
    backprop: the network's forward and backward passes. values: its forward pass alone.

    Its users do not know the library, so the type checker does not see it here; inside the passes it does.
    """

    backprop: Backprop[Any]
    values: Callable[[Any], Any]
    theta: Any
    gradient: Any

    def __init__(self, network: FlatNetwork, example: Tensor | None) -> None:
        """example: see `make_backprop`, which may raise."""
        form = network.in_numpy if isinstance(network.in_numpy, Dense) else None
        self.in_numpy = form is not None
        self.values = form or network
        theta, gradient = network.flat, torch.zeros_like(network.flat)
        arrays: tuple[Any, Any] = (theta, gradient) if form is None else (theta.numpy(), gradient.numpy())
        self._like, in_passes = self.theta, self.gradient = arrays
        self.gradients = network.views(in_passes)
        match form:
            case None:
                self.backprop = make_backprop(network.module, example)
            case ConvolutionNetwork():
                self.backprop = ConvolutionBackprop(form)
                # With many parameters, PyTorch's fused operations are worth their calls.
                self.theta, self.gradient = theta, gradient
            case _:
                self.backprop = NumpyBackprop(form)

    def cast(self, array: AnyArray) -> Any:  # noqa: ANN401
        """Convert an array of either library for this network's passes."""
        return convert_like(array, self._like)
