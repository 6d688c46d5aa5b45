"""Error-driven learning of any module through autograd: equal to the chain, and to an SVD of each sample."""

import pytest
import torch
from custom_networks import Borrowed, Centred, Doubled, Duel, Pictures, Recurrent, Residual, Tied, Twice
from torch import Tensor, nn

from coop.common.networks.network import build_network
from coop.common.types import EnvSpec
from coop.learner.edl.autograd_backprop import AutogradBackprop
from coop.learner.edl.backprop import Subspace, UnsupportedLayerError
from coop.learner.edl.completed import Jacobians
from coop.learner.edl.feedback import FeedbackRule, edl_gradients, feedback_matrices
from coop.learner.edl.layers import _examined, make_backprop
from coop.learner.edl.torch_backprop import TorchBackprop
from coop.learner.edl.transforms import Transforms


def _inputs(shape: tuple[int, ...], actions: int, batch: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(batch, *shape, generator=generator, dtype=torch.float64)
    error = torch.zeros(batch, actions, dtype=torch.float64)
    taken = torch.randint(actions, (batch,), generator=generator)
    error[torch.arange(batch), taken] = torch.randn(batch, generator=generator, dtype=torch.float64) / batch
    return x, error


def _by_svd(network: nn.Module, x: Tensor, error: Tensor, s: float) -> dict[str, Tensor]:
    """Gradients from the equations, sample after sample: B(i) = U (S + s I) V^T over T(i)'s nonzero singular values.

    Parameters outside Linear and Conv2d get the ordinary gradient.
    """
    gradients = {name: torch.zeros_like(p) for name, p in network.named_parameters()}
    layers = {name: layer for name, layer in network.named_modules() if isinstance(layer, nn.Linear | nn.Conv2d)}
    for sample, e in zip(x, error, strict=True):
        outputs: dict[str, Tensor] = {}

        def keep(name: str, output: Tensor, outputs: dict[str, Tensor] = outputs) -> Tensor:
            outputs[name] = output
            return output.clone()

        hooks = [layer.register_forward_hook(lambda _, __, out, n=n: keep(n, out)) for n, layer in layers.items()]
        y = network(sample[None])[0]
        for hook in hooks:
            hook.remove()
        for name, layer in layers.items():
            a = outputs[name]
            rows = torch.stack([torch.autograd.grad(value, a, retain_graph=True)[0].flatten() for value in y])
            u, values, vt = torch.linalg.svd(rows, full_matrices=False)
            kept = (values > 1e-9 * values[0]).double()
            sigma = (u * (values + s) * kept @ vt).T @ e
            parts = dict(layer.named_parameters())
            found = torch.autograd.grad(a, list(parts.values()), sigma.view(a.shape), retain_graph=True)
            for part, gradient in zip(parts, found, strict=True):
                gradients[f"{name}.{part}"] += gradient
        rest = [name for name in gradients if name.rpartition(".")[0] not in layers]
        if rest:
            found = torch.autograd.grad(y, [network.get_parameter(name) for name in rest], e, retain_graph=True)
            for name, gradient in zip(rest, found, strict=True):
                gradients[name] += gradient
    return gradients


def _relative(got: dict[str, Tensor], want: dict[str, Tensor]) -> float:
    """The largest relative difference of one parameter's gradient."""
    assert got.keys() == want.keys()
    return max(float((got[name].double() - want[name]).norm() / want[name].norm()) for name in want)


def _plain(kind: str, actions: int) -> tuple[nn.Module, tuple[int, ...]]:
    spec = EnvSpec("v", (4,), "float32", 1, actions) if kind == "mlp" else EnvSpec("p", (84, 84), "uint8", 4, actions)
    return build_network(kind, spec, (96, 96), 3).double(), spec.obs_shape


@pytest.mark.parametrize("feedback", ["transform", "weight-gradient", "random", "none"])
@pytest.mark.parametrize(("kind", "actions", "batch"), [("mlp", 2, 32), ("mlp", 6, 9), ("nips2013", 4, 3)])
def test_autograd_and_the_chain_agree(kind: str, actions: int, batch: int, feedback: str) -> None:
    network, shape = _plain(kind, actions)
    x, error = _inputs(shape, actions, batch)
    found = []
    for dtype in (torch.float64, torch.float32):
        network, x, error = network.to(dtype), x.to(dtype), error.to(dtype)
        for passes in (TorchBackprop(network), _examined(network, x)):
            out = {name: torch.full_like(p, torch.nan) for name, p in network.named_parameters()}
            tape = passes.forward(x)
            with torch.inference_mode():
                FeedbackRule(passes, feedback, seed=5).backward(tape, error, 0.4, out)
            found.append(out)
    chain, graph, single_chain, single = found
    assert _relative(graph, chain) < 1e-9
    assert _relative(single, single_chain) < 1e-5


def _networks(actions: int) -> list[tuple[nn.Module, tuple[int, ...]]]:
    torch.manual_seed(actions)
    networks: list[tuple[nn.Module, tuple[int, ...]]] = [
        (Duel(5, actions), (5,)),
        (Residual(5, actions), (5,)),
        (Pictures(3, 49, actions), (3, 7, 7)),
        (nn.Sequential(nn.Linear(5, 40), nn.Tanh(), nn.Linear(40, actions)), (5,)),
        (Recurrent(actions), (5,)),
        (Doubled(nn.Linear(5, 40), nn.ReLU(), nn.Linear(40, actions)), (5,)),
    ]
    return [(network.double(), shape) for network, shape in networks]


@pytest.mark.parametrize("index", range(6))
@pytest.mark.parametrize(("actions", "batch"), [(2, 16), (3, 7), (6, 1), (9, 12)])
def test_autograd_and_the_svd_of_each_sample_agree(index: int, actions: int, batch: int) -> None:
    network, shape = _networks(actions)[index]
    x, error = _inputs(shape, actions, batch)
    for s in (0.0, 0.3):
        expected = _by_svd(network.double(), x, error, s)
        assert _relative(edl_gradients(network, x, error, s), expected) < 1e-9
        single = edl_gradients(network.float(), x.float(), error.float(), s)
        assert _relative(single, expected) < 1e-4


def test_without_feedback_any_parameter_gets_the_ordinary_gradient() -> None:
    network = Twice(5, 3).double()
    x, error = _inputs((5,), 3, 8)
    expected = dict(
        zip(
            dict(network.named_parameters()),
            torch.autograd.grad(network(x), list(network.parameters()), error),
            strict=True,
        )
    )
    assert _relative(edl_gradients(network, x, error, 0.7, "none"), expected) < 1e-12
    assert isinstance(make_backprop(network, None), AutogradBackprop)
    assert isinstance(make_backprop(nn.Sequential(nn.Linear(5, 3)), x), TorchBackprop)


@pytest.mark.parametrize("actions", [2, 3, 6])
def test_what_no_weight_can_reach_gets_no_feedback(actions: int) -> None:
    """The advantages' mean is subtracted: their T has rank A - 1, and no completion adds the lost direction."""
    network, shape = _networks(actions)[0]
    x, _ = _inputs(shape, actions, 8)
    s = 0.25
    matrices = feedback_matrices(network, x, s)
    assert set(matrices) == {"trunk", "value.0", "value.2", "advantage.0", "advantage.2"}
    for name, b in matrices.items():
        values = torch.linalg.svdvals(b)
        full = {"trunk": actions, "value": 1, "advantage": actions - 1}[name.split(".")[0]]
        assert (values[:, :full] >= s * (1 - 1e-6)).all()
        assert (values[:, full:] < 1e-9).all()
    assert float(matrices["advantage.2"].sum(1).abs().max()) < 1e-12
    unit = torch.full((8, actions, 1), 1.0, dtype=torch.float64)
    torch.testing.assert_close(matrices["value.2"], unit * (1 + s * actions**-0.5))


@pytest.mark.parametrize("actions", [2, 6])
def test_a_dueling_network_needs_no_completion(actions: int) -> None:
    """Not even one whose values differ little between actions."""
    network, shape = _networks(actions)[0]
    with torch.no_grad():
        network.get_parameter("value.2.weight").mul_(30)
    x = _inputs(shape, actions, 32)[0].float()
    passes = make_backprop(network.float(), x)
    jacobians = Transforms(passes, passes.forward(x))._jacobians()
    layers, _, _ = jacobians._solve(torch.eye(actions, dtype=torch.float64)[None, None])
    completed = [layer.completed() for layer in layers]
    assert len(completed) == 5
    assert not any(mixing.any() for _, mixing in completed)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("actions", [2, 3, 4, 18])
def test_dead_units_are_completed_within_the_range(actions: int, dtype: torch.dtype) -> None:
    network, shape = _networks(actions)[0]
    network = network.to(dtype)
    x, error = (given.to(dtype) for given in _inputs(shape, actions, 8))
    zero = 1e-9 if dtype == torch.float64 else 1e-5
    with torch.no_grad():
        network.get_parameter("advantage.0.bias").fill_(-100.0)
    for b in (feedback_matrices(network, x, 0.25)[name].double() for name in ("advantage.0", "advantage.2")):
        values = torch.linalg.svdvals(b)
        assert (values[:, : actions - 1] >= 0.25 * (1 - 1e-5)).all()
        assert (values[:, actions - 1 :] < zero).all()
        assert float(b.sum(1).abs().max()) < zero
    assert all(torch.isfinite(g).all() for g in edl_gradients(network, x, error, 0.25).values())


def test_rounding_in_a_range_is_no_rank() -> None:
    """A T of 0 is completed in its range of rank 2 also where the range's projection misses 1 by a bit."""
    almost = 1 - 2.0**-53
    basis = torch.tensor([[0.0, 0.0], [almost, 0.0], [0.0, almost]], dtype=torch.float64)
    t, units = torch.zeros(1, 3, 5, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    reach = Subspace(basis, 2)
    (b,) = Jacobians([t], [reach], units, 1).matrices(0.25)
    torch.testing.assert_close(torch.linalg.svdvals(b)[0], torch.tensor([0.25, 0.25, 0.0], dtype=torch.float64))


def test_a_bottleneck_gets_the_thin_factor() -> None:
    """One unit between the layers before it and four actions: their T has rank 1, in a direction that weights move.

    In the directions that T lacks, its rounding is multiplied by the root of the ridge's inverse, 3e6: each eps of
    the row sums, which each BLAS and processor adds in an order of its own, is some 1e-9.
    """
    torch.manual_seed(0)
    network = nn.Sequential(
        nn.Linear(5, 30), nn.Tanh(), nn.Linear(30, 1), nn.Tanh(), nn.Linear(1, 30), nn.Tanh(), nn.Linear(30, 4)
    )
    x, error = _inputs((5,), 4, 6)
    network = network.double()
    assert _relative(edl_gradients(network, x, error, 0.3), _by_svd(network, x, error, 0.3)) < 1e-8


def test_initial_weights_of_zero_hide_no_rank() -> None:
    network = Residual(5, 3).double()
    nn.init.zeros_(network.out.weight)
    x, _ = _inputs((5,), 3, 4)
    for b in feedback_matrices(network, x, 0.5).values():
        torch.testing.assert_close(torch.linalg.svdvals(b)[:, 2] >= 0.5 * (1 - 1e-6), torch.ones(4, dtype=torch.bool))


def _frozen() -> nn.Module:
    network = nn.Sequential(nn.Linear(5, 3), nn.Tanh())
    network[0].bias.requires_grad_(False)
    return network


@pytest.mark.parametrize(
    ("network", "text"),
    [
        (Twice(5, 3), "layer 'inner' (Linear) is used twice in a forward pass"),
        (Tied(5, 3), "layers 'inner' and 'other' share a parameter"),
        (Borrowed(5, 3), "layer 'inner' (Linear): its parameters are also used outside it"),
        (Centred(5, 3), "layer 'inner' (Linear): the samples of a batch meet after it"),
        (nn.Sequential(nn.Linear(5, 4), nn.BatchNorm1d(4), nn.Linear(4, 3)),
         "layer '1' is a BatchNorm1d, in which the samples of a batch meet"),
        (nn.Sequential(nn.Linear(5, 4), nn.InstanceNorm1d(4, track_running_stats=True), nn.Linear(4, 3)),
         "layer '1' (InstanceNorm1d) has a buffer, 'running_mean'; only parameters are trained and saved"),
        (nn.Sequential(nn.Unflatten(0, (-1, 2)), nn.Linear(5, 3), nn.Flatten(0, 1)),
         "layer '1' (Linear) gives [3, 2, 3] for a batch of 6; its first axis must be the batch"),
        (_frozen(), "parameter '0.bias' does not require a gradient"),
        (nn.Sequential(nn.LayerNorm(5)), "no Linear or Conv2d layer takes error-driven feedback"),
    ],
)  # fmt: skip
def test_what_has_no_meaning_is_refused_by_name(network: nn.Module, text: str) -> None:
    x, error = torch.randn(6, 5), torch.zeros(6, 3)
    with pytest.raises(UnsupportedLayerError) as refused:
        edl_gradients(network, x, error, 0.1)
    assert str(refused.value) == text
