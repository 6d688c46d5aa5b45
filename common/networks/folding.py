"""Convolutions of few channels as others of more: a picture's columns, as many as the stride, become channels.

Pictures of four frames have four channels, for which cuDNN finds slow kernels only, and whose layout it first converts.
With the channels last in memory, s columns of C channels are s C channels of one column without a copy; the kernel
[out, C, h, w] with stride s then is [out, s C, h, w / s] with stride 1 in that direction. The sums have the same terms.
"""

from __future__ import annotations

from torch import Tensor, nn

MOST = 32  # channels


def folds(layer: nn.Conv2d, width: int) -> bool:
    """Whether a convolution of pictures of this width has such a form, with at most `MOST` channels."""
    across = layer.stride[1]
    plain = (layer.padding, layer.dilation, layer.groups) == ((0, 0), (1, 1), 1)
    whole = layer.kernel_size[1] % across == 0 and width % across == 0
    return plain and across > 1 and whole and layer.in_channels * across <= MOST


def fold(array: Tensor, across: int) -> Tensor:
    """Pictures or kernels [n, C, h, w] as [n, across C, h, w / across], both with the channels last in memory."""
    n, channels, height, width = array.shape
    last = array.permute(0, 2, 3, 1).reshape(n, height, width // across, across * channels)
    return last.permute(0, 3, 1, 2)


def unfold(array: Tensor, across: int) -> Tensor:
    """Undo `fold`."""
    n, channels, height, width = array.shape
    last = array.permute(0, 2, 3, 1).reshape(n, height, width * across, channels // across)
    return last.permute(0, 3, 1, 2)
