"""Small networks in numpy: the same values and gradients as the same networks in PyTorch."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch import nn

from coop.common.networks.convolution import Dense
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.types import Array, EnvSpec
from coop.learner.edl.feedback import FEEDBACKS, FeedbackRule, feedback_matrices
from coop.learner.edl.numpy_backprop import NumpyBackprop
from coop.learner.edl.torch_backprop import TorchBackprop


def _mlp(widths: list[int], seed: int) -> nn.Sequential:
    torch.manual_seed(seed)
    steps: list[nn.Module] = []
    for before, after in pairwise(widths):
        steps += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*steps[:-1]).double()


def _compare(network: nn.Sequential, feedback: str, s: float, x: Array, error: Array) -> None:
    found = {name: np.full(p.shape, np.nan) for name, p in network.named_parameters()}
    expected = {name: torch.full(p.shape, torch.nan).double() for name, p in network.named_parameters()}
    rule, other = FeedbackRule(NumpyBackprop(Dense(network)), feedback), FeedbackRule(TorchBackprop(network), feedback)
    tape = rule.backprop.forward(x)
    rule.backward(tape, error, s, found)
    with torch.no_grad():
        other_tape = other.backprop.forward(torch.from_numpy(x))
        other.backward(other_tape, torch.from_numpy(error), s, expected)
    np.testing.assert_allclose(tape.output, other_tape.output, rtol=1e-10, atol=1e-12)
    for name, gradient in expected.items():
        atol = 1e-6 * float(gradient.abs().max())
        np.testing.assert_allclose(found[name], gradient, rtol=1e-6, atol=atol, err_msg=name)


@settings(max_examples=settings.default.max_examples // 2)
@given(
    hidden=st.lists(st.integers(2, 24), max_size=3),
    actions=st.integers(2, 6),
    batch=st.integers(1, 20),
    seed=st.integers(0, 1000),
    feedback=st.sampled_from(["none", "transform", "random"]),
    s=st.sampled_from([0.0, 0.3, -1.0]),
)
def test_gradients_agree(hidden: list[int], actions: int, batch: int, seed: int, feedback: str, s: float) -> None:
    network = _mlp([3, *hidden, actions], seed)
    rng = np.random.default_rng(seed)
    x, error = rng.standard_normal((batch, 3)), rng.standard_normal((batch, actions))
    if feedback == "transform":  # a transform that lacks rank has more than one polar factor
        for t in feedback_matrices(network, torch.from_numpy(x), 0.0).values():
            assume(float(torch.linalg.svdvals(t).min()) > 1e-4)
    _compare(network, feedback, s, x, error)


@pytest.mark.parametrize("feedback", FEEDBACKS)
def test_gradients_agree_in_a_trained_size(feedback: str) -> None:
    # The gradients of a wide network lack rank, and have more than one polar factor.
    width = 6 if feedback == "weight-gradient" else 128
    rng = np.random.default_rng(0)
    network = _mlp([4, width, width, 2], 0)
    _compare(network, feedback, 0.1, rng.standard_normal((256, 4)), rng.standard_normal((256, 2)))


def test_samples_that_lack_rank_get_a_whole_polar_factor() -> None:
    """A hidden layer with one live unit: T has rank 1, and B = T + s P must still have no singular value below s."""
    network = _mlp([3, 5, 2], 0)
    hidden = network[0]
    assert isinstance(hidden, nn.Linear)
    hidden.bias.data[:] = torch.tensor([9.0, -9, -9, -9, -9])
    x, s = np.random.default_rng(0).standard_normal((4, 3)), 0.5
    rule = FeedbackRule(NumpyBackprop(Dense(network)))
    out = {name: np.empty(p.shape) for name, p in network.named_parameters()}
    b = np.empty((4, 2, 5))
    for sample, row in np.ndindex(4, 2):  # the hidden layer's bias gradient is B^T e
        with np.errstate(divide="ignore", invalid="ignore"):  # as an update does
            rule.backward(rule.backprop.forward(x[[sample]]), np.eye(2)[[row]], s, out)
        b[sample, row] = out["0.bias"]
    values = np.linalg.svd(b, compute_uv=False)
    t, whole = (feedback_matrices(network, torch.from_numpy(x), rate)["0"] for rate in (0.0, s))
    expected = torch.linalg.svdvals(t) + s
    assert (expected[:, 0] > s * 1.01).all()
    np.testing.assert_allclose(values, expected, rtol=1e-6)
    torch.testing.assert_close(torch.linalg.svdvals(whole), expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("kind", ["mlp", "nature"])
def test_a_network_has_a_form_in_numpy_where_it_is_small_and_dense(kind: str) -> None:
    shape = (4,) if kind == "mlp" else (84, 84)
    spec = EnvSpec("case", shape, "float32" if kind == "mlp" else "uint8", 1, 3)
    network = FlatNetwork(build_network(kind, spec, (8, 8), 0))
    assert (network.in_numpy is not None) == (kind == "mlp")
    assert FlatNetwork(build_network(kind, spec, (8, 8), 0).bfloat16()).in_numpy is None


def test_it_follows_the_parameters() -> None:
    network = FlatNetwork(build_network("mlp", EnvSpec("case", (4,), "float32", 1, 3), (8,), 0))
    assert network.in_numpy is not None
    x = np.ones((2, 4), np.float32)
    before = network.in_numpy(x)
    network.load(2 * network.snapshot())
    with torch.no_grad():
        np.testing.assert_allclose(network.in_numpy(x), network(torch.from_numpy(x)).numpy(), rtol=1e-6)
    assert not np.allclose(network.in_numpy(x), before)


@pytest.mark.parametrize(
    "module",
    [
        nn.Sequential(nn.Linear(3, 2), nn.Linear(2, 2)),
        nn.Sequential(nn.Linear(3, 2, bias=False)),
        nn.Sequential(nn.Flatten(), nn.Linear(3, 2)),
        nn.Sequential(nn.Linear(3, 2), nn.ReLU()),
        nn.Sequential(),
        nn.Linear(3, 2),
    ],
)
def test_what_does_not_fit(module: nn.Module) -> None:
    assert not Dense.fits(module)
