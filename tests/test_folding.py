"""Convolutions whose columns become channels give what they give without."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import nn

from coop.common.networks.folding import fold, folds, unfold


@pytest.mark.parametrize(
    ("channels", "kernel", "stride", "size"), [(4, 8, 4, 84), (3, (5, 4), (3, 2), (20, 10)), (1, (1, 6), (1, 3), 12)]
)
@pytest.mark.parametrize("last", [True, False], ids=["channels last", "channels first"])
def test_outputs_and_gradients_are_those_of_the_convolution(
    channels: int, kernel: int, stride: int, size: int | tuple[int, int], last: bool
) -> None:
    torch.manual_seed(0)
    layer = nn.Conv2d(channels, 6, kernel, stride).double()
    height, width = (size, size) if isinstance(size, int) else size
    x = torch.randn(5, channels, height, width, dtype=torch.float64)
    if last:
        x = x.contiguous(memory_format=torch.channels_last)
    assert folds(layer, width)
    down, across = layer.stride
    weight = layer.weight.detach()
    folded = fold(x, across)
    if last:
        assert folded.data_ptr() == x.data_ptr(), "no copy"
    plain, narrow = F.conv2d(x, weight, None, (down, across)), F.conv2d(folded, fold(weight, across), None, (down, 1))
    torch.testing.assert_close(narrow, plain)
    torch.testing.assert_close(unfold(folded, across), x, rtol=0, atol=0)
    delta = torch.randn_like(plain)
    gradient = torch.nn.grad.conv2d_weight(x, weight.shape, delta, (down, across))
    narrow = torch.nn.grad.conv2d_weight(folded, fold(weight, across).shape, delta, (down, 1))
    torch.testing.assert_close(unfold(narrow, across), gradient)


@pytest.mark.parametrize(
    ("layer", "width"),
    [
        (nn.Conv2d(4, 6, 8, 4), 86),
        (nn.Conv2d(4, 6, 7, 4), 84),
        (nn.Conv2d(4, 6, 8, 4, padding=4), 84),
        (nn.Conv2d(4, 6, 8, 4, groups=2), 84),
        (nn.Conv2d(4, 6, 8, 4, dilation=2), 84),
        (nn.Conv2d(4, 6, 3, 1), 84),
        (nn.Conv2d(32, 64, 4, 2), 20),
    ],
    ids=str,
)
def test_other_convolutions_stay_as_they_are(layer: nn.Conv2d, width: int) -> None:
    assert not folds(layer, width)
