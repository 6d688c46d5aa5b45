"""A network for training: flat parameters, their gradient, and the forward and backward passes."""

from __future__ import annotations

from torch import Tensor

from common.networks.network import FlatNetwork
from learner.edl.arrays import Array, convert_like, namespace
from learner.edl.dense import DenseChain
from learner.edl.layers import make_passes
from learner.edl.passes import Passes


class Trainable:
    """The network's own parameters and their gradient, as tensors or, with `in_numpy`, as numpy arrays.

    theta, gradient: <float>[P], in the order of the network's layout. gradients: name -> view of `gradient`, in the
    shape of the parameter. chain: the network's forward and backward passes. values: its forward pass alone.
    """

    def __init__(self, network: FlatNetwork, in_numpy: bool, example: Tensor | None) -> None:
        """in_numpy: use numpy if the network has a form in numpy. example: see `make_passes`, which may raise."""
        dense = network.dense if in_numpy else None
        self.in_numpy = dense is not None
        self.chain: Passes = make_passes(network.module, example) if dense is None else DenseChain(dense)
        self.values = dense or network
        self.theta: Array = network.flat if dense is None else network.flat.numpy()
        self.gradient: Array = namespace(self.theta).zeros_like(self.theta)
        self.gradients = network.views(self.gradient)

    def cast(self, array: Array) -> Array:
        """Convert an array of either library for this network's passes."""
        return convert_like(array, self.theta)
