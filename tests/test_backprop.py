"""The hand-written passes of plain stacks: against autograd, without side effects, and what they refuse by name."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from coop.common.networks.convolution import ConvolutionNetwork, Dense
from coop.learner.edl.backprop import UnsupportedLayerError
from coop.learner.edl.convolution import ConvolutionBackprop
from coop.learner.edl.numpy_backprop import NumpyBackprop
from coop.learner.edl.torch_backprop import TorchBackprop


def _uneven() -> nn.Sequential:
    """Every option of a convolution, inputs that strides do not fill, layers without bias, and a narrow layer."""
    torch.manual_seed(0)
    narrow = nn.Linear(7, 1)
    nn.init.constant_(narrow.bias, 3.0)  # alive
    return nn.Sequential(
        nn.Conv2d(2, 4, 3, stride=(1, 2)), nn.ReLU(),
        nn.Sequential(
            nn.Conv2d(4, 6, (2, 3), stride=(2, 1), padding=(1, 2), dilation=(1, 2), groups=2, bias=False), nn.ReLU(),
            nn.Flatten(),
        ),
        nn.Linear(6 * 4 * 4, 7, bias=False), nn.ReLU(), nn.Flatten(),
        narrow, nn.ReLU(), nn.Linear(1, 3),
    ).double()  # fmt: skip


def _inputs(batch: int) -> Tensor:
    return torch.randn(batch, 2, 9, 10, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def _jacobians(network: nn.Sequential, x: Tensor) -> list[Tensor]:
    """d output / d pre-activation of each layer with parameters, last first, by autograd: [batch, actions, *shape]."""
    outputs: list[Tensor] = []
    layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear | nn.Conv2d)]
    handles = [layer.register_forward_hook(lambda _, __, output: outputs.append(output)) for layer in layers]
    y = network(x)
    for handle in handles:
        handle.remove()
    rows = [torch.autograd.grad(column.sum(), outputs, retain_graph=True) for column in y.unbind(1)]
    return [torch.stack(parts, 1) for parts in reversed(list(zip(*rows, strict=True)))]


@pytest.mark.parametrize("batch", [1, 3, 5])
@pytest.mark.parametrize("shared", [False, True])
def test_cotangents_are_those_of_autograd(batch: int, shared: bool) -> None:
    """Units as cotangents, one set for all samples or one for each; as many samples as actions is a case of its own."""
    network, x = _uneven(), _inputs(batch)
    backprop = TorchBackprop(network)
    units = torch.eye(3, dtype=torch.float64).expand(1 if shared else batch, 3, 3).clone()
    before = units.clone()
    with torch.no_grad():
        found = list(backprop.cotangents(backprop.forward(x), units))
    expected = _jacobians(network, x)
    assert [index for index, _ in found] == list(reversed(backprop.parametrised)) == [10, 8, 5, 2, 0]
    for (_, rows), jacobian in zip(found, expected, strict=True):
        torch.testing.assert_close(rows.expand_as(jacobian), jacobian)
        assert jacobian.any()
    assert torch.equal(units, before)


@pytest.mark.parametrize("batch", [1, 4])
def test_gradients_are_those_of_autograd(batch: int) -> None:
    network, x = _uneven(), _inputs(batch)
    error = torch.randn(batch, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    names = dict(network.named_parameters())
    expected = torch.autograd.grad(network(x), list(names.values()), error)
    backprop, out = TorchBackprop(network), {name: torch.full_like(p, torch.nan) for name, p in names.items()}
    with torch.no_grad():
        tape = backprop.forward(x)
        for index, delta in backprop.cotangents(tape, error[:, None]):
            backprop.write_gradients(tape, index, delta[:, 0], out)
    for name, gradient in zip(names, expected, strict=True):
        torch.testing.assert_close(out[name], gradient)


@pytest.mark.parametrize("batch", [1, 2, 3])
def test_a_relu_at_the_end_leaves_the_callers_cotangents(batch: int) -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(2, 4), nn.ReLU(), nn.Linear(4, 2), nn.ReLU()).double()
    x, backprop = torch.randn(batch, 2, dtype=torch.float64), TorchBackprop(network)
    for b in {1, batch}:
        cotangents = torch.randn(b, 2, 2, dtype=torch.float64)
        before = cotangents.clone()
        with torch.no_grad():
            found = [rows for _, rows in backprop.cotangents(backprop.forward(x), cotangents)]
        assert torch.equal(cotangents, before)
        for rows, jacobian in zip(found, _jacobians(network, x), strict=True):
            torch.testing.assert_close(rows, before @ jacobian)


@pytest.mark.parametrize("narrow", [False, True])
@pytest.mark.parametrize(
    ("kind", "form"),
    [(lambda n: NumpyBackprop(Dense(n)), "mlp"), (lambda n: ConvolutionBackprop(ConvolutionNetwork(n)), "")],
)
def test_the_passes_in_numpy_walk_the_same_way(kind: Callable[[Any], Any], form: str, narrow: bool) -> None:
    """Each k of the cotangents by itself, also through a layer of one unit."""
    torch.manual_seed(0)
    width = 1 if narrow else 6
    first: list[nn.Module] = [nn.Linear(5, 8)] if form else [nn.Conv2d(1, 2, 2), nn.ReLU(), nn.Flatten()]
    middle: list[nn.Module] = [nn.ReLU(), nn.Linear(8, width)] if form else [nn.Linear(8, width)]
    network = nn.Sequential(*first, *middle, nn.ReLU(), nn.Linear(width, 3)).double()
    nn.init.constant_(network[-3].bias, 3.0)  # alive
    x = torch.randn(4, *((5,) if form else (1, 3, 3)), dtype=torch.float64)
    backprop, other = kind(network), TorchBackprop(network)
    for b in (1, 4):
        cotangents = torch.randn(b, 3, 3, dtype=torch.float64)
        with torch.no_grad():
            expected = [rows for _, rows in other.cotangents(other.forward(x), cotangents)]
        found = [rows for _, rows in backprop.cotangents(backprop.forward(x.numpy()), cotangents.numpy().copy())]
        for rows, wanted in zip(found, expected, strict=True):
            torch.testing.assert_close(torch.from_numpy(rows).reshape(wanted.shape), wanted)
            assert wanted.any()


RELU, LINEAR = nn.ReLU(), nn.Linear(2, 2)


@pytest.mark.parametrize(
    ("network", "text"),
    [
        (nn.Sequential(nn.Linear(2, 2), nn.Sequential(nn.Tanh())),
         "layer '1.0' is a Tanh; handled are Linear, Conv2d, ReLU and Flatten"),
        (nn.Sequential(nn.Flatten(2), LINEAR), "layer '0': a Flatten must start at dimension 1 and end at -1"),
        (nn.Sequential(nn.Flatten(1, 2), LINEAR), "layer '0': a Flatten must start at dimension 1 and end at -1"),
        (nn.Sequential(nn.Conv2d(1, 1, 3, padding="same")), "layer '0': a Conv2d must pad with zeros, by a given size"),
        (nn.Sequential(nn.Conv2d(1, 1, 3, padding=1, padding_mode="circular")),
         "layer '0': a Conv2d must pad with zeros, by a given size"),
        (nn.Sequential(RELU), "the network must hold parameters, and none twice"),
        (nn.Sequential(LINEAR, RELU, LINEAR), "the network must hold parameters, and none twice"),
    ],
)  # fmt: skip
def test_what_a_plain_stack_does_not_hold(network: nn.Sequential, text: str) -> None:
    with pytest.raises(UnsupportedLayerError) as refused:
        TorchBackprop(network)
    assert str(refused.value) == text
