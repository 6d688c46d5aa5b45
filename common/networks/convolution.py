"""Networks of Linear layers, and of one convolution before them, as matrix products over arrays of numpy.

Behind a convolution the batch is the last axis of every array, so a picture's windows are copied in long runs, and no
array is transposed before the Linear layers. The products are PyTorch's, whose library (MKL) takes half the time of
numpy's for these sizes; everything else costs less to call in numpy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial

import numpy as np
import torch
from torch import nn

from coop.common.networks.forward import DenseForward
from coop.common.types import Array

DTYPES = (torch.float32, torch.float64)


class Dense(DenseForward):
    """The forward pass of such a module."""

    def __init__(self, module: nn.Module) -> None:
        """`module` must fit (see `fits`)."""
        layers = [(name, step) for name, step in module.named_children() if isinstance(step, nn.Linear | nn.Conv2d)]
        super().__init__(
            [f"{name}." for name, _ in layers],
            [step.weight.detach().flatten(1).numpy() for _, step in layers],
            [step.bias.detach().numpy()[:, None] for _, step in layers if step.bias is not None],
        )

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


_CACHED = 2**14  # numbers that the windows of one picture may hold to stay in the cache with those of a batch
_SMALL = 2**18  # multiplications below which numpy's product is the faster one, with its shorter call


def product(a: Array, b: Array, out: Array | None = None) -> Array:
    """The matrix product of a [m, k] and b [k, n], in `out` [m, n] if that is given."""
    if a.size * b.shape[1] < _SMALL:
        return np.dot(a, b, out)
    if out is not None:
        bound_product(a, b, out)()
        return out
    result: Array = torch.mm(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    return result


def bound_product(a: Array, b: Array, out: Array) -> Callable[[], object]:
    """What computes `product` of arrays that stay where they are, as often as it is called."""
    if a.size * b.shape[1] < _SMALL:
        return partial(np.dot, a, b, out)
    return partial(torch.mm, torch.from_numpy(a), torch.from_numpy(b), out=torch.from_numpy(out))


class ConvolutionNetwork(Dense):
    """The forward pass of such a network, over the parameters in place.

    The convolution's weight is [out, channels * height * width].

    kernel: of the convolution, height and width.
    """

    def __init__(self, module: nn.Module) -> None:
        """`module` must fit (see `fits`)."""
        super().__init__(module)
        convolution = next(module.children())
        assert isinstance(convolution, nn.Conv2d)
        self.kernel, self._stride = convolution.kernel_size, convolution.stride
        self._geometry = lru_cache(maxsize=16)(self._geometry_of)

    @staticmethod
    def fits(module: nn.Module) -> bool:
        """Whether a network is Conv2d, ReLU, Flatten, Linear, ReLU, Linear, ..., Linear in a float on the CPU.

        All layers must have biases, and the convolution neither padding, dilation nor groups. PyTorch is faster for
        large pictures and for later convolutions.
        """
        match list(module) if type(module) is nn.Sequential else []:
            case [
                nn.Conv2d() as convolution,
                nn.ReLU(),
                nn.Flatten(start_dim=1, end_dim=-1),
                nn.Linear() as linear,
                *rest,
            ]:
                return (
                    type(convolution) is nn.Conv2d
                    and convolution.padding == (0, 0)
                    and convolution.dilation == (1, 1)
                    and convolution.groups == 1
                    and convolution.bias is not None
                    and all(p.device.type == "cpu" and p.dtype in DTYPES for p in convolution.parameters())
                    and Dense.fits(nn.Sequential(linear, *rest))
                    and convolution.weight[0].numel() * linear.in_features <= _CACHED * convolution.out_channels
                )
        return False

    def activations(self, x: Array) -> list[Array]:
        """What the kernel sees, the output of each ReLU, and the network's output: [batch, ...] each.

        They are views of arrays with the batch last. What the kernel sees at a place ends with a one, for the bias:
        [batch, places, channels * height * width + 1].
        """
        windows = self._windows(x)
        return [windows.T, *(column.T for column in self._behind(windows))]

    def _columns(self, x: Array) -> Iterator[Array]:
        return self._behind(self._windows(x))

    def _behind(self, windows: Array) -> Iterator[Array]:
        """Yield each ReLU's and the network's output: [n, batch]."""
        with np.errstate(over="ignore", invalid="ignore"):  # of diverging networks, as in PyTorch
            kernel = np.concatenate((self.weights[0], self.biases[0]), axis=1)
            column = product(kernel, windows.reshape(len(windows), -1)).reshape(-1, windows.shape[-1])
            for weight, bias in zip(self.weights[1:], self.biases[1:], strict=True):
                yield np.maximum(column, 0, out=column)
                column = product(weight, column)
                column += bias
            yield column

    def _windows(self, x: Array) -> Array:
        """What the kernel sees at each place of pictures x, and a one: [inputs + 1, places, batch]."""
        pictures = np.ascontiguousarray(x.transpose(1, 2, 3, 0), dtype=self.weights[0].dtype)
        inputs = self.weights[0].shape[1]
        shape, strides = self._geometry(pictures.shape, pictures.strides)
        windows = np.empty((inputs + 1, shape[3] * shape[4], shape[5]), pictures.dtype)
        windows[:inputs].reshape(shape)[...] = np.ndarray(shape, pictures.dtype, pictures, 0, strides)
        windows[inputs] = 1
        return windows

    def _geometry_of(self, shape: tuple[int, ...], strides: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The shape [channels, *kernel, *places, batch] of the view of all windows of pictures, and its strides."""
        (channels, *sides, batch), (plane, row, column, sample) = shape, strides
        down, right = self._stride
        return (
            (channels, *self.kernel, *self.places(sides), batch),
            (plane, row, column, row * down, column * right, sample),
        )

    def places(self, sides: Sequence[int]) -> tuple[int, ...]:
        """Of the kernel in a picture of this height and width, down and across."""
        steps = zip(sides, self.kernel, self._stride, strict=True)
        return tuple((side - kernel) // stride + 1 for side, kernel, stride in steps)
