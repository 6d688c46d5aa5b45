"""Error-driven learning: one update by hand, s = 0 is backpropagation, and the equations by plain SVDs."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from coop.common.networks.convolution import Dense
from coop.common.networks.network import build_network
from coop.common.types import EnvSpec
from coop.learner.edl.feedback import FeedbackRule, edl_gradients, feedback_matrices
from coop.learner.edl.numpy_backprop import NumpyBackprop
from coop.learner.edl.torch_backprop import TorchBackprop
from coop.learner.edl.transforms import Transforms, _basis


def _spec(kind: str, actions: int) -> EnvSpec:
    if kind == "mlp":
        return EnvSpec("vector", (4,), "float32", 1, actions)
    return EnvSpec("pictures", (84, 84), "uint8", 4, actions)


def _case(kind: str, actions: int, batch: int, seed: int = 0) -> tuple[nn.Sequential, Tensor, Tensor]:
    """A float64 network, an input batch, and errors of one action each."""
    spec = _spec(kind, actions)
    network = build_network(kind, spec, (16, 16), seed).double()
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(batch, *spec.obs_shape, generator=generator, dtype=torch.float64)
    error = torch.zeros(batch, actions, dtype=torch.float64)
    taken = torch.randint(actions, (batch,), generator=generator)
    error[torch.arange(batch), taken] = torch.randn(batch, generator=generator, dtype=torch.float64) / batch
    return network, x, error


def _reference(network: nn.Sequential, x: Tensor, error: Tensor, s: float) -> dict[str, Tensor]:
    """Gradients from the equations: T(i) by autograd, B(i) = U (S + s I) V^T by SVD, one sample after the other."""
    gradients = {name: torch.zeros_like(p) for name, p in network.named_parameters()}
    for sample, e in zip(x, error, strict=True):
        inputs, outputs, h = {}, {}, sample[None]
        for name, layer in network.named_children():
            inputs[name] = h.detach()
            h = layer(h)
            outputs[name] = h
        for name, layer in network.named_children():
            if not isinstance(layer, nn.Linear | nn.Conv2d):
                continue
            a = outputs[name]
            rows = [torch.autograd.grad(y, a, retain_graph=True)[0].flatten() for y in h[0]]
            u, values, vt = torch.linalg.svd(torch.stack(rows), full_matrices=False)
            sigma = (u * (values + s) @ vt).T @ e
            layer.zero_grad()
            layer(inputs[name]).backward(sigma.view(a.shape))
            for part, p in layer.named_parameters():
                assert p.grad is not None
                gradients[f"{name}.{part}"] += p.grad
    return gradients


def _relative(got: dict[str, Tensor], want: dict[str, Tensor]) -> float:
    assert got.keys() == want.keys()
    difference = torch.cat([(got[name].double() - want[name]).flatten() for name in want])
    return float(difference.norm() / torch.cat([g.flatten() for g in want.values()]).norm())


@pytest.mark.parametrize("s", [0.0, 0.5, 1.0, -0.25])
def test_one_update_by_hand(s: float) -> None:
    """A network 2-3-2 whose third hidden unit is dead.

    x = (1, 2);  a1 = W1 x = (1, 2, -1), h = (1, 2, 0);  y = W2 h = (4, -3).
    T(2) = I, so B(2) = (1 + s) I;  sigma(2) = (1 + s) (1, 2).
    T(1) = W2 with the dead unit's column out = [[0, 2, 0], [-3, 0, 0]]: singular values 3 and 2, polar factor
    U V^T = [[0, 1, 0], [-1, 0, 0]];  B(1) = T(1) + s U V^T = [[0, 2 + s, 0], [-3 - s, 0, 0]];
    sigma(1) = B(1)^T (1, 2) = (-6 - 2 s, 2 + s, 0).  Gradients: sigma(2) h^T, sigma(2), sigma(1) x^T, sigma(1).
    """
    network = nn.Sequential(nn.Linear(2, 3), nn.ReLU(), nn.Linear(3, 2))
    with torch.no_grad():
        network[0].weight.copy_(torch.tensor([[1.0, 0], [0, 1], [-1, 0]]))
        network[2].weight.copy_(torch.tensor([[0.0, 2, 5], [-3, 0, 7]]))
        network[0].bias.zero_()
        network[2].bias.zero_()
    x, error = torch.tensor([[1.0, 2]]), torch.tensor([[1.0, 2]])
    expected = {
        "0.weight": [[-6 - 2 * s, -12 - 4 * s], [2 + s, 4 + 2 * s], [0, 0]],
        "0.bias": [-6 - 2 * s, 2 + s, 0],
        "2.weight": [[1 + s, 2 + 2 * s, 0], [2 + 2 * s, 4 + 4 * s, 0]],
        "2.bias": [1 + s, 2 + 2 * s],
    }
    gradients = edl_gradients(network, x, error, s)
    assert gradients.keys() == expected.keys()
    for name, numbers in expected.items():
        torch.testing.assert_close(gradients[name], torch.tensor(numbers, dtype=torch.float32))
    b = feedback_matrices(network, x, s)
    assert list(b) == ["0", "2"]
    torch.testing.assert_close(b["0"][0], torch.tensor([[0.0, 2 + s, 0], [-3 - s, 0, 0]]))
    torch.testing.assert_close(b["2"][0], (1 + s) * torch.eye(2))


@pytest.mark.parametrize("kind", ["mlp", "nature", "nips2013"])
@pytest.mark.parametrize("feedback", ["transform", "weight-gradient"])
def test_without_s_it_is_backpropagation(kind: str, feedback: str) -> None:
    network, x, error = _case(kind, 4, 8)
    loss = (network(x) * error).sum()  # d loss / d y = error, as for 1/2 e^2
    loss.backward()
    expected = {name: p.grad for name, p in network.named_parameters() if p.grad is not None}
    assert _relative(edl_gradients(network, x, error, 0.0, feedback), expected) < 1e-12
    single = edl_gradients(network.float(), x.float(), error.float(), 0.0, feedback)
    assert _relative(single, expected) < 1e-6


def _train(network: nn.Sequential, x: Tensor) -> None:
    """Fit fixed values, by backpropagation, so that weights and Jacobians are no longer those of a new network."""
    target = torch.linspace(-1, 1, len(x), dtype=x.dtype)[:, None] * torch.arange(1, len(network[-1].bias) + 1)
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    for _ in range(30):
        optimizer.zero_grad()
        (network(x) - target).square().mean().backward()
        optimizer.step()
    optimizer.zero_grad()


@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize(
    ("kind", "actions", "batch"),
    [
        ("mlp", 2, 64), ("mlp", 3, 16), ("mlp", 6, 1), ("mlp", 9, 33), ("mlp", 18, 4),
        ("nips2013", 2, 5), ("nips2013", 6, 2), ("nature", 2, 3), ("nature", 4, 2), ("nature", 6, 1), ("nature", 18, 1),
    ],
)  # fmt: skip
def test_the_equations_by_svd(kind: str, actions: int, batch: int, trained: bool) -> None:
    network, x, error = _case(kind, actions, batch, seed=3)
    if kind == "mlp":  # enough live units that every T(i) has full rank, where B(i) is unique
        network = build_network(kind, _spec(kind, actions), (128, 128), 3).double()
    if trained:
        _train(network, x)
    expected = _reference(network, x, error, 0.3)
    assert _relative(edl_gradients(network, x, error, 0.3), expected) < 1e-6
    single = edl_gradients(network.float(), x.float(), error.float(), 0.3)
    assert _relative(single, expected) < 1e-4


@settings(max_examples=settings.default.max_examples // 2)
@given(st.integers(0, 2**31), st.booleans(), st.integers(2, 18), st.integers(1, 20))
def test_the_equations_on_any_mlp(seed: int, trained: bool, actions: int, batch: int) -> None:
    network = build_network("mlp", _spec("mlp", actions), (96, 96), seed).double()
    _, x, error = _case("mlp", actions, batch, seed)
    if trained:
        _train(network, x)
    expected = _reference(network, x, error, 0.7)
    assert _relative(edl_gradients(network, x, error, 0.7), expected) < 1e-6
    assert _relative(edl_gradients(network.float(), x.float(), error.float(), 0.7), expected) < 1e-4


@pytest.mark.parametrize("actions", [2, 3, 5])
def test_layers_without_a_relu_between_them_have_one_transform_for_all_samples(actions: int) -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 20), nn.Linear(20, actions)).double()
    _, x, error = _case("mlp", actions, 7)
    assert _relative(edl_gradients(network, x, error, 0.3), _reference(network, x, error, 0.3)) < 1e-9
    values = torch.linalg.svdvals(network[1].weight) + 0.3
    torch.testing.assert_close(torch.linalg.svdvals(feedback_matrices(network, x, 0.3)["0"]), values.expand(7, -1))


@pytest.mark.parametrize("actions", [2, 5])
def test_samples_without_full_rank_leave_the_others_alone(actions: int) -> None:
    """Inputs of zero make the hidden layers of some samples die; the others still follow the equations."""
    network, x, error = _case("mlp", actions, 12, seed=5)
    network = build_network("mlp", _spec("mlp", actions), (128, 128), 5).double()
    with torch.no_grad():
        network.get_parameter("fc1.bias").fill_(-0.01)
        network.get_parameter("fc2.bias").fill_(-0.01)
        x[::3] = 0
    b = feedback_matrices(network, x, 0.4)
    live = [i for i in range(12) if i % 3]
    expected = _reference(network, x[live], error[live], 0.4)
    got = edl_gradients(network, x, error, 0.4)
    dead = edl_gradients(network, x[::3], error[::3], 0.4)
    assert _relative({name: got[name] - dead[name] for name in got}, expected) < 1e-6
    for name, t in feedback_matrices(network, x, 0.0).items():
        torch.testing.assert_close(torch.linalg.svdvals(b[name]), torch.linalg.svdvals(t) + 0.4, rtol=1e-6, atol=1e-6)
    for name, matrices in b.items():  # the gradient of a bias is B^T e, summed over the batch
        sigma = torch.einsum("ba,ban->n", error, matrices)
        torch.testing.assert_close(got[f"{name}.bias"], sigma, rtol=1e-6, atol=1e-9)


@settings(max_examples=settings.default.max_examples // 2)
@given(st.integers(0, 2**31), st.sampled_from(["dead", "duplicate", "near", "zero"]), st.integers(2, 6))
def test_lost_rank_is_harmless(seed: int, fault: str, actions: int) -> None:
    network, x, error = _case("mlp", actions, 5, seed)
    last = network.get_submodule("out")
    middle = network.get_submodule("fc2")
    assert isinstance(last, nn.Linear)
    assert isinstance(middle, nn.Linear)
    with torch.no_grad():
        match fault:
            case "dead":
                middle.bias.fill_(-100.0)
            case "duplicate":
                last.weight[1] = last.weight[0]
            case "near":
                last.weight[1] = last.weight[0] * (1 + 1e-9)
            case "zero":
                last.weight.zero_()
    s = 0.2
    assert all(torch.isfinite(g).all() for g in edl_gradients(network, x, error, s).values())
    single = edl_gradients(network.float(), x.float(), error.float(), s)
    assert all(torch.isfinite(g).all() for g in single.values())
    for b in feedback_matrices(network.double(), x, s).values():
        assert float(torch.linalg.svdvals(b).min()) >= s * (1 - 1e-3)


def _random_feedback(network: nn.Sequential, x: Tensor, s: float, **seed: int) -> dict[str, Tensor]:
    """The fixed B(i) [actions, n] of each layer: the gradient of its bias, for an error of 1 of each action in turn."""
    units = torch.eye(3, dtype=x.dtype)
    rows = [edl_gradients(network, x, e[None], s, "random", **seed) for e in units]
    return {name: torch.stack([row[f"{name}.bias"] for row in rows]) for name in ("fc1", "fc2", "out")}


def test_random_feedback_is_fixed() -> None:
    """A row of B(i) is a draw of its own of length about 1 (sd 0.035); B of the last layer is the identity."""
    network = build_network("mlp", _spec("mlp", 3), (400, 400), 0).double()
    first, second = torch.randn(2, 1, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    fixed = _random_feedback(network, first, 0.0)
    for again in (_random_feedback(network, second, 0.7), _random_feedback(network, first, 0.0, seed=0)):
        for name, matrix in fixed.items():
            torch.testing.assert_close(again[name], matrix)
    other = _random_feedback(network, first, 0.0, seed=1)
    assert torch.equal(fixed["out"], torch.eye(3, dtype=torch.float64))
    rows = torch.cat([fixed["fc1"], fixed["fc2"], other["fc1"], other["fc2"]])
    torch.testing.assert_close(rows @ rows.T, torch.eye(12, dtype=torch.float64), atol=0.25, rtol=0)
    rule, zero = (FeedbackRule(TorchBackprop(network), "random", **seed) for seed in ({}, {"seed": 0}))
    tape, error = rule.backprop.forward(first), torch.eye(3, dtype=torch.float64)[:1]
    for index in rule.backprop.parametrised:
        assert torch.equal(rule._aligned(tape, index, error), zero._aligned(tape, index, error))


def test_random_feedback_is_the_identity_at_the_end_alone() -> None:
    """Also where hidden layers are as wide as there are actions."""
    network = build_network("mlp", _spec("mlp", 3), (3, 3), 0).double()
    fixed = _random_feedback(network, torch.ones(1, 4, dtype=torch.float64), 0.5)
    units = torch.eye(3, dtype=torch.float64)
    assert torch.equal(fixed["out"], units)
    assert not torch.allclose(fixed["fc1"], units)
    assert not torch.allclose(fixed["fc2"], units)


@pytest.mark.parametrize("library", [np.asarray, torch.as_tensor])
@pytest.mark.parametrize("actions", [2, 3, 4, 6])
def test_the_basis_is_orthogonal_and_parts_the_common_value(actions: int, library: Any) -> None:
    """Its first row is the mean's; or, in numpy with many actions and a weight W, it makes rows of Q W orthogonal."""
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(actions, 9, generator=generator) + 3
    output = library(torch.zeros(5, actions))
    for one in (None, weight, weight * torch.nan):
        q = torch.as_tensor(_basis(None if one is None else library(one), output))
        assert q.dtype == torch.float32
        torch.testing.assert_close(q @ q.T, torch.eye(actions), atol=1e-6, rtol=0)
        if one is None or actions <= 3 or library is torch.as_tensor:
            torch.testing.assert_close(q[0], torch.full((actions,), actions**-0.5))
        elif one is weight:
            gram = q @ weight @ weight.T @ q.T
            torch.testing.assert_close(gram, torch.diag(gram.diagonal()), atol=1e-3, rtol=0)


def test_transforms_in_numpy_start_from_the_basis_of_the_output_weight() -> None:
    network, x, _ = _case("mlp", 6, 3)
    backprop = NumpyBackprop(Dense(network))
    weight = network.get_parameter("out.weight").detach().numpy()
    rows = Transforms(backprop, backprop.forward(x.numpy()))._basis @ weight
    gram = rows @ rows.T
    np.testing.assert_allclose(gram, np.diag(gram.diagonal()), atol=1e-7)
