"""A network as training sees it: flat parameters, their gradient, and the passes that make it."""

from __future__ import annotations

from common.networks.network import FlatNetwork
from learner.edl.arrays import Array, like, namespace
from learner.edl.backprop import Chain
from learner.edl.dense import DenseChain


class Trainable:
    """The network's own parameters and a gradient beside them, all tensors or, `in_numpy`, all numpy arrays.

    theta, gradient: <float>[P], in the order of the network's layout. gradients: name -> view of `gradient`, in the
    shape of the parameter. chain: the network's forward and backward passes. values: its forward pass alone.
    """

    def __init__(self, network: FlatNetwork, in_numpy: bool) -> None:
        """`in_numpy` asks for numpy, and holds where the network has that form."""
        dense = network.dense if in_numpy else None
        self.in_numpy = dense is not None
        self.chain = Chain(network.module) if dense is None else DenseChain(dense)
        self.values = dense or network
        self.theta: Array = network.flat if dense is None else network.flat.numpy()
        self.gradient: Array = namespace(self.theta).zeros_like(self.theta)
        self.gradients = network.views(self.gradient)

    def cast(self, array: Array) -> Array:
        """An array of either library as this network's passes take it."""
        return like(array, self.theta)
