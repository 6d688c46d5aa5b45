"""Networks that normalise their inputs and pre-activations, for methods that learn from single steps, in numpy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from coop.common.types import Array

Floats = NDArray[np.float32]
_UNSCALED = np.ones((1, 1), np.float32)


class Standardize(nn.Module):
    """(x - mean) / sd for each input. They are saved with the parameters, but no gradient changes them.

    mean, sd: float32 [*input].
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.zeros(shape), requires_grad=False)
        self.sd = nn.Parameter(torch.ones(shape), requires_grad=False)

    def forward(self, x: Tensor) -> Tensor:
        """Standardize inputs, float32 [batch, *input]."""
        return (x - self.mean) / self.sd


class LayerPass(NamedTuple):
    """The forward pass of one layer, for the gradient.

    inputs: float32 [batch, in], or [batch, in, places] of a convolution. normalised: float32 [batch, out * places],
    the pre-activations after normalisation, or the network's output. scale: float32 [batch, 1], the reciprocal of the
    standard deviation by which they were divided; of the output, that of a batch of one.
    """

    inputs: Floats
    normalised: Floats
    scale: Floats


class NormalisedLayer:
    """One Linear or Conv2d layer.

    weight: float32 [out, in]. bias: float32 [out]. windows: int [in, places], which inputs a kernel sees at each place;
    None for a Linear layer. average: float32 [out * places, 1], by which a product gives the mean of pre-activations
    in a fraction of the time of `mean`.
    """

    def __init__(self, module: nn.Linear | nn.Conv2d, shape: tuple[int, ...]) -> None:
        """shape: of the layer's input without the batch."""
        assert module.bias is not None
        self.weight: Floats = module.weight.detach().flatten(1).numpy()
        self.bias: Floats = module.bias.detach().numpy()
        self.windows = _windows(module, shape) if isinstance(module, nn.Conv2d) else None
        size = len(self.bias) * (1 if self.windows is None else self.windows.shape[1])
        self.average = np.full((size, 1), 1 / size, np.float32)

    def __call__(self, x: Floats) -> tuple[Floats, Floats]:
        """What the layer sees (see `LayerPass`), and its pre-activations, float32 [batch, out * places]."""
        if self.windows is None:
            return x, x.dot(self.weight.T) + self.bias
        seen = x.take(self.windows, axis=1)
        return seen, (np.matmul(self.weight, seen) + self.bias[:, None]).reshape(len(x), -1)


class NormalisedNetwork:
    """The forward pass of such a network, over the parameters in place.

    layers: the last one gives the Q-values. slope: of the leaky ReLUs for negative numbers.
    """

    def __init__(self, module: nn.Module) -> None:
        """`module` must fit (see `fits`)."""
        first, *steps = module.children()
        assert isinstance(first, Standardize)
        self.mean: Floats = first.mean.numpy()
        self.sd: Floats = first.sd.numpy()
        norms = [step for step in steps if isinstance(step, nn.LayerNorm)]
        self.slope = np.float32(next((step.negative_slope for step in steps if isinstance(step, nn.LeakyReLU)), 0.0))
        self._eps = np.float32(norms[0].eps if norms else 0.0)
        shapes = [tuple(self.mean.shape), *(norm.normalized_shape for norm in norms)]
        linear = [step for step in steps if isinstance(step, nn.Linear | nn.Conv2d)]
        self.layers = [NormalisedLayer(step, shape) for step, shape in zip(linear, shapes, strict=True)]

    @staticmethod
    def fits(module: nn.Module) -> bool:
        """Whether a network is one of `coop.common.networks.sparse.sparse_network`, in float32 on the CPU."""
        first = next(module.children(), None)
        return isinstance(first, Standardize) and first.mean.device.type == "cpu" and first.mean.dtype == torch.float32

    def __call__(self, x: Array) -> Floats:
        """float32 [batch, *input] -> [batch, actions]."""
        return self.record(x)[-1].normalised

    def record(self, x: Array) -> list[LayerPass]:
        """The forward pass of each layer for inputs float32 [batch, *input]."""
        records = []
        with np.errstate(all="ignore"):  # of diverging networks, as in PyTorch
            h: Floats = ((x - self.mean) / self.sd).reshape(len(x), -1)
            for layer in self.layers[:-1]:
                seen, y = layer(h)
                average = layer.average
                y -= y.dot(average)
                scale = 1 / np.sqrt((y * y).dot(average) + self._eps)
                y *= scale
                records.append(LayerPass(seen, y, scale))
                h = np.maximum(y, self.slope * y)
            records.append(LayerPass(*self.layers[-1](h), _UNSCALED))
        return records


def _windows(convolution: nn.Conv2d, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """The indices of the flattened picture [channels, height, width] that the kernel sees: [inputs, places]."""
    picture = np.arange(int(np.prod(shape))).reshape(shape)
    (height, width), (down, right) = convolution.kernel_size, convolution.stride
    views = np.lib.stride_tricks.sliding_window_view(picture, (height, width), (1, 2))[:, ::down, ::right]
    channels, rows, columns = views.shape[:3]
    return np.ascontiguousarray(views.transpose(0, 3, 4, 1, 2)).reshape(channels * height * width, rows * columns)
