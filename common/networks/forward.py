"""What acting needs of a network, without PyTorch: the layout of its parameters, its inputs and its forward pass."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from coop.common.types import Array, EnvSpec

if TYPE_CHECKING:
    import torch
    from torch import Tensor

ArrayT = TypeVar("ArrayT", "Tensor", NDArray[Any])
Layout = list[tuple[str, tuple[int, ...]]]  # name and shape of each parameter, in the order of the buffer


def mlp_layout(spec: EnvSpec, hidden: Sequence[int]) -> Layout:
    """The layout of the kind "mlp": linear layers of the widths in `hidden`, then one for the actions."""
    layout: Layout = []
    width = math.prod(spec.input_shape)
    names = [f"fc{number}" for number in range(1, len(hidden) + 1)]
    for name, size in zip([*names, "out"], [*hidden, spec.num_actions], strict=True):
        layout += [(f"{name}.weight", (size, width)), (f"{name}.bias", (size,))]
        width = size
    return layout


def size_of(layout: Layout) -> int:
    """The number of parameters."""
    return sum(math.prod(shape) for _, shape in layout)


def views(flat: ArrayT, layout: Layout) -> dict[str, ArrayT]:
    """Each parameter's part of a flat array or tensor [P], by name and in the parameter's shape."""
    sizes = [math.prod(shape) for _, shape in layout]
    stops = itertools.accumulate(sizes)
    return {
        name: flat[stop - size : stop].reshape(shape)
        for (name, shape), size, stop in zip(layout, sizes, stops, strict=True)
    }


def digest(layout: Layout) -> str:
    """16 hex digits, equal for two layouts if and only if these are equal; compared when a role joins."""
    return hashlib.sha256(repr(layout).encode()).hexdigest()[:16]


def preprocess(obs: ArrayT, spec: EnvSpec, dtype: torch.dtype | None = None) -> ArrayT:
    """The network's input for stored observations: <frame_dtype>[batch, *obs_shape] -> <dtype>[batch, *input_shape].

    It stays with its library, PyTorch or numpy, and on its device. uint8 is scaled to [0, 1]; bool becomes 0 and 1.
    Planes are ordered by frame, oldest first, then by channel.

    dtype: for tensors; float32 if None, as in numpy.
    """
    if not isinstance(obs, np.ndarray):
        obs = obs.float() if dtype is None else obs.to(dtype)
    elif spec.frame_dtype != "float32":
        obs = obs.astype(np.float32)
    if spec.frame_dtype == "uint8":
        obs *= 1 / 255
    if len(spec.frame_shape) == 3:
        obs = obs.swapaxes(-1, -2).swapaxes(-2, -3)  # channels first; `moveaxis` takes longer than a small network
    return obs if obs.shape[1:] == spec.input_shape else obs.reshape(-1, *spec.input_shape)


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
