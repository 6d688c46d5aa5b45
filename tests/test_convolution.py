"""Networks of one convolution as matrix products in numpy: the values and gradients of the same networks in PyTorch."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from coop.common.networks.convolution import ConvolutionNetwork
from coop.common.networks.network import FlatNetwork
from coop.common.settings.config import LearnerSettings
from coop.common.types import Array
from coop.learner.edl.convolution import ConvolutionBackprop
from coop.learner.edl.feedback import FEEDBACKS, FeedbackRule
from coop.learner.edl.torch_backprop import TorchBackprop
from coop.learner.optimizers import make_optimizer


def _network(geometry: tuple[Any, ...], shape: tuple[int, int], hidden: list[int], actions: int) -> nn.Sequential:
    torch.manual_seed(0)
    conv = nn.Conv2d(*geometry)
    width = nn.Flatten()(conv(torch.zeros(1, conv.in_channels, *shape))).shape[1]
    steps: list[nn.Module] = [conv, nn.ReLU(), nn.Flatten()]
    for size in hidden:
        steps += [nn.Linear(width, size), nn.ReLU()]
        width = size
    return nn.Sequential(*steps, nn.Linear(width, actions)).double()


def _pictures(batch: int, channels: int, shape: tuple[int, int]) -> Array:
    return (np.random.default_rng(0).random((batch, channels, *shape)) < 0.3).astype(np.float64)


CASES: list[tuple[tuple[Any, ...], tuple[int, int], list[int], int, int]] = [  # the first: arguments of the convolution
    ((4, 16, 3), (10, 10), [128], 3, 32),
    ((4, 16, 3), (10, 10), [128], 6, 7),
    ((2, 5, (2, 3), (1, 2)), (6, 9), [40, 30], 2, 20),
    ((1, 6, 4, 3), (11, 8), [], 4, 3),
    ((3, 8, 3), (5, 5), [20], 1, 4),
    ((3, 8, 3), (5, 5), [20], 3, 1),
]


@pytest.mark.parametrize("feedback", FEEDBACKS)
@pytest.mark.parametrize(("geometry", "shape", "hidden", "actions", "batch"), CASES)
def test_values_and_gradients_agree(
    geometry: tuple[Any, ...], shape: tuple[int, int], hidden: list[int], actions: int, batch: int, feedback: str
) -> None:
    network = _network(geometry, shape, hidden, actions)
    # The gradients of a wide layer in a small batch lack rank, and have more than one polar factor.
    s = 0.0 if feedback == "weight-gradient" and hidden else 0.3
    x, error = _pictures(batch, geometry[0], shape), np.random.default_rng(1).standard_normal((batch, actions))
    for dtype, rtol in ((np.float64, 1e-9), (np.float32, 1e-5)):
        network.double() if dtype is np.float64 else network.float()
        found = {name: np.full(p.shape, np.nan, dtype) for name, p in network.named_parameters()}
        expected = {name: torch.from_numpy(array.copy()) for name, array in found.items()}
        rule = FeedbackRule(ConvolutionBackprop(ConvolutionNetwork(network)), feedback)
        other = FeedbackRule(TorchBackprop(network), feedback)
        with torch.no_grad():
            tape, other_tape = (
                rule.backprop.forward(x.astype(dtype)),
                other.backprop.forward(torch.from_numpy(x.astype(dtype))),
            )
            rule.backward(tape, error.astype(dtype), s, found)
            other.backward(other_tape, torch.from_numpy(error.astype(dtype)), s, expected)
        np.testing.assert_allclose(tape.output, other_tape.output, rtol=rtol, atol=rtol)
        for name, gradient in expected.items():
            np.testing.assert_allclose(found[name], gradient, rtol=0, atol=rtol * float(gradient.norm()), err_msg=name)


def test_the_head_of_a_tape_is_the_tape_of_the_first_samples() -> None:
    module = _network((2, 5, 3), (6, 6), [20], 3)
    backprop, x, error = ConvolutionBackprop(ConvolutionNetwork(module)), _pictures(8, 2, (6, 6)), np.ones((3, 3))
    gradients = []
    for tape in (backprop.forward(x).head(3), backprop.forward(x[:3])):
        out = {name: np.empty(p.shape) for name, p in module.named_parameters()}
        FeedbackRule(backprop, "transform").backward(tape, error, 0.3, out)
        gradients.append(out)
    for name, gradient in gradients[0].items():
        np.testing.assert_allclose(gradient, gradients[1][name], rtol=1e-9)


def test_it_follows_the_parameters() -> None:
    network = FlatNetwork(_network((2, 5, 3), (6, 6), [20], 3).float())
    assert isinstance(network.in_numpy, ConvolutionNetwork)
    x = _pictures(2, 2, (6, 6)).astype(np.float32)
    before = network.in_numpy(x)
    network.load(2 * network.snapshot())
    with torch.no_grad():
        np.testing.assert_allclose(network.in_numpy(x), network(torch.from_numpy(x)).numpy(), rtol=1e-5)
    assert not np.allclose(network.in_numpy(x), before)


@pytest.mark.parametrize(
    "module",
    [
        nn.Sequential(nn.Conv2d(4, 8, 8, 4), nn.ReLU(), nn.Flatten(), nn.Linear(8 * 400, 2)),
        nn.Sequential(nn.Conv2d(1, 2, 3, padding=1), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2)),
        nn.Sequential(nn.Conv2d(1, 2, 3, padding="same"), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2)),
        nn.Sequential(nn.Conv2d(1, 2, 3, dilation=2), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2)),
        nn.Sequential(nn.Conv2d(2, 2, 3, groups=2), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2)),
        nn.Sequential(nn.Conv2d(1, 2, 3, bias=False), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2)),
        nn.Sequential(nn.Conv2d(1, 2, 3), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2, bias=False)),
        nn.Sequential(nn.Conv2d(1, 2, 3), nn.ReLU(), nn.Flatten(2), nn.Linear(8, 2)),
        nn.Sequential(nn.Conv2d(1, 2, 3), nn.ReLU(), nn.Conv2d(2, 2, 3), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2)),
        nn.Sequential(nn.Conv2d(1, 2, 3), nn.Flatten(), nn.ReLU(), nn.Linear(8, 2)),
        nn.Sequential(nn.Conv2d(1, 2, 3), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2), nn.ReLU()),
        nn.Sequential(nn.Conv2d(1, 2, 3), nn.ReLU(), nn.Flatten()),
        nn.Sequential(nn.Conv2d(1, 2, 3), nn.ReLU(), nn.Flatten(), nn.Linear(8, 2)).bfloat16(),
    ],
)
def test_what_does_not_fit(module: nn.Module) -> None:
    assert not ConvolutionNetwork.fits(module)


def test_running_means_do_not_become_denormals() -> None:
    """A parameter without gradient, whose means decay to 0: arithmetic with denormals takes 30 times as long."""
    settings = LearnerSettings(optimizer="rmsprop", momentum=0.9, alpha=0.9, eps=1e-3)
    theta, gradient = torch.zeros(8), torch.ones(8)
    optimizer = make_optimizer(settings, theta, gradient)
    optimizer.step(0.1)
    gradient.zero_()
    for _ in range(900):
        optimizer.step(0.1)
    for name, mean in optimizer.buffers.items():
        assert not mean.any(), name
    assert float(torch.tensor(1e-38) / 100) > 0, "elsewhere denormals are kept"
