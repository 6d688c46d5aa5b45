"""Which layers of any module take error-driven feedback, and passes through the modules that are odd in some way."""

import pytest
import torch
from custom_networks import Centred, Duel, Negative, Residual
from test_graph import _by_svd, _inputs, _networks, _relative
from torch import Tensor, nn

from coop.learner.edl.autograd_backprop import AutogradBackprop, FeedbackLayer
from coop.learner.edl.backprop import Tape, UnsupportedLayerError
from coop.learner.edl.feedback import FeedbackRule, edl_gradients, feedback_matrices
from coop.learner.edl.layers import _range, make_backprop


class Odd(nn.Module):
    """Calls a layer by keyword, runs one without using it, holds a parameter that nothing uses, and one dead layer."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.Linear(5, 20)
        self.idle = nn.Linear(5, 20)
        self.dead = nn.Linear(5, 20)
        self.unused = nn.Parameter(torch.ones(3))
        self.out = nn.Linear(20, 3)

    def forward(self, x: Tensor) -> Tensor:
        self.idle(x)
        return self.out(input=torch.tanh(self.inner(input=x)) + torch.relu(-self.dead(x).square() - 1))


class Own(nn.Linear):
    """A Linear by another name, which is the whole module."""


class Lender(nn.Module):
    """Its layer's weight acts a little outside the layer, too."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.Linear(5, 5)
        self.out = nn.Linear(5, 3)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(torch.tanh(self.inner(x)) + 0.02 * x @ self.inner.weight)


class Moody(nn.Module):
    """Runs its layers as often as `runs` says, once each when it is examined."""

    def __init__(self) -> None:
        super().__init__()
        self.inner, self.other, self.out = nn.Linear(5, 5), nn.Linear(5, 5), nn.Linear(5, 3)
        self.runs = (1, 1)

    def forward(self, x: Tensor) -> Tensor:
        for layer, times in zip((self.inner, self.other), self.runs, strict=True):
            for _ in range(times):
                x = torch.tanh(layer(x))
        return self.out(x)


@pytest.mark.parametrize("s", [0.0, 0.3])
def test_what_the_output_does_not_depend_on_gets_no_gradient(s: float) -> None:
    torch.manual_seed(0)
    network = Odd().double()
    x, error = _inputs((5,), 3, 6)
    assert set(feedback_matrices(network, x, s)) == {"inner", "dead", "out"}
    found = edl_gradients(network, x, error, s)
    for name in ("idle.weight", "idle.bias", "dead.weight", "dead.bias", "unused"):
        assert not found.pop(name).any(), name
    plain = nn.Sequential(network.inner, nn.Tanh(), network.out)
    expected = _by_svd(plain, x, error, s)
    torch.testing.assert_close(found["inner.weight"], expected["0.weight"])
    torch.testing.assert_close(found["inner.bias"], expected["0.bias"])
    shifted = torch.tanh(network.inner(x)).detach()
    torch.testing.assert_close(found["out.weight"], (1 + s) * error.T @ shifted)
    torch.testing.assert_close(found["out.bias"], (1 + s) * error.sum(0))


def test_a_module_that_is_a_layer_itself() -> None:
    """T is the identity: the gradients are (1 + s) e x^T and (1 + s) e, summed over the batch."""
    network = Own(5, 3).double()
    x, error = _inputs((5,), 3, 6)
    found = edl_gradients(network, x, error, 0.5)
    torch.testing.assert_close(found["weight"], 1.5 * error.T @ x)
    torch.testing.assert_close(found["bias"], 1.5 * error.sum(0))
    assert list(feedback_matrices(network, x, 0.5)) == [""]


@pytest.mark.parametrize(("index", "ends"), [(0, None), (1, "out.weight"), (5, None)])
def test_the_output_weight_is_that_of_a_linear_at_the_end(index: int, ends: str | None) -> None:
    """A dueling head has its mean subtracted and a doubled stack its output doubled, so no layer's output is theirs."""
    network, shape = _networks(3)[index]
    passes = make_backprop(network, _inputs(shape, 3, 4)[0])
    assert isinstance(passes, AutogradBackprop)
    assert passes.output_weight is (network.get_parameter(ends) if ends else None)


@pytest.mark.parametrize(
    ("network", "batch", "text"),
    [
        (Lender(), 6, "layer 'inner' (Linear): its parameters are also used outside it"),
        (Centred(5, 3), 2, "layer 'inner' (Linear): the samples of a batch meet after it"),
        (nn.Sequential(Negative(5, 3), nn.Tanh()), 6, "no Linear or Conv2d layer takes error-driven feedback"),
        (nn.utils.parametrizations.weight_norm(Own(5, 3)), 6, "no Linear or Conv2d layer takes error-driven feedback"),
    ],
)
def test_what_takes_no_feedback(network: nn.Module, batch: int, text: str) -> None:
    with pytest.raises(UnsupportedLayerError) as refused:
        make_backprop(network, torch.randn(batch, 5, generator=torch.Generator().manual_seed(0)))
    assert str(refused.value) == text


@pytest.mark.parametrize("runs", [(1, 0), (2, 1), (2, 0)])
def test_a_module_must_run_each_layer_once_later_too(runs: tuple[int, int]) -> None:
    network = Moody()
    passes = make_backprop(network, x := torch.randn(6, 5))
    passes.forward(x)
    network.runs = runs
    with pytest.raises(UnsupportedLayerError, match=r"^its layers do not run once in every forward pass$"):
        passes.forward(x)


def test_the_head_of_a_tape_is_the_tape_of_the_first_samples() -> None:
    network = Duel(5, 3).double()
    passes = make_backprop(network, x := _inputs((5,), 3, 8)[0])
    tape = passes.forward(x)
    assert tape.head(8) is tape
    error = torch.ones(3, 3, dtype=torch.float64)
    head = tape.head(3)
    torch.testing.assert_close(head.output, tape.output[:3])
    gradients = []
    for one in (head, passes.forward(x[:3])):
        out = {name: torch.full_like(p, torch.nan) for name, p in network.named_parameters()}
        with torch.no_grad():
            FeedbackRule(passes).backward(one, error, 0.3, out)
        gradients.append(out)
    assert _relative(*gradients) < 1e-12
    again = head.head(2)
    torch.testing.assert_close(again.output, tape.output[:2])


def test_a_tape_of_other_passes_holds_no_graph() -> None:
    passes = make_backprop(Residual(5, 3), x := torch.randn(6, 5))
    with pytest.raises(TypeError, match=r"^a Tape holds no graph$"):
        next(passes.cotangents(Tape(torch.zeros(6, 3), [x]), torch.zeros(6, 1, 3)))


def test_passes_leave_no_hooks_behind() -> None:
    network = Residual(5, 3)
    make_backprop(network, x := torch.randn(6, 5)).forward(x)
    assert not any(layer._forward_hooks for layer in network.modules())


@pytest.mark.parametrize("size", [1e-3, 1e-4])
def test_a_direction_that_is_seldom_strong_is_no_lost_rank(size: float) -> None:
    """One action follows its units a thousandth as much as the others do; its T still has full rank."""

    class Faint(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner, self.out = nn.Linear(5, 20), nn.Linear(20, 3)
            self.sizes = torch.tensor([1.0, 1.0, size], dtype=torch.float64)

        def forward(self, x: Tensor) -> Tensor:
            return self.out(torch.tanh(self.inner(x))) * self.sizes

    torch.manual_seed(0)
    network = Faint().double()
    x, error = _inputs((5,), 3, 6)
    assert make_backprop(network, x).range_of(0) is None
    assert _relative(edl_gradients(network, x, error, 0.3), _by_svd(network, x, error, 0.3)) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_range_of_a_dueling_head_lies_beside_the_mean(dtype: torch.dtype) -> None:
    """Advantages reach the two directions beside (1, 1, 1), the value only that one, the trunk all three."""
    torch.manual_seed(0)
    passes = make_backprop(Duel(5, 3).to(dtype), _inputs((5,), 3, 8)[0].to(dtype))
    mean = torch.full((3, 3), 1 / 3, dtype=torch.float64)
    others = torch.eye(3, dtype=torch.float64) - mean
    expected = {"trunk.": None, "advantage.0.": (others, 2), "advantage.2.": (others, 2), "value.0.": (mean, 1),
                "value.2.": (mean, 1)}  # fmt: skip
    assert passes.names == list(expected)
    for index, wanted in enumerate(expected.values()):
        found = passes.range_of(index)
        assert (found is None) == (wanted is None)
        if found is not None and wanted is not None:
            projection, rank = wanted
            assert found.rank == rank
            torch.testing.assert_close(found.basis @ found.basis.T, projection, rtol=0, atol=1e-6)


class Given:
    """A trial whose T is known: [batch, actions, n]."""

    def __init__(self, *rows: list[float]) -> None:
        self._t = torch.tensor([rows], dtype=torch.float64)

    def transforms(self, _: FeedbackLayer) -> Tensor:
        return self._t


FAINT = (1.5e-10 / 4) ** 0.5  # an eigenvalue of 1.5e-10 of T T^T, whose largest is 4


@pytest.mark.parametrize(
    ("trials", "rank", "basis"),
    [
        ([Given([1, 0], [0, 0], [0, 0]), Given([0, 0], [0, 1e-8], [0, 0])], 1, [[1, 0, 0], [0, 1, 0]]),
        ([Given([1, 0], [0, 3e-6])], 1, [[1, 0]]),
        ([Given([1, FAINT], [1, -FAINT], [1, FAINT], [1, -FAINT])], 1, [[0.5, 0.5, 0.5, 0.5]]),
        ([Given([0.3, 0.7, 0.9], [0.6, 1.4, 1.8], [1.1 * 0.3, 1.1 * 0.7, 1.1 * 0.9])], 1, [[1, 2, 1.1]]),
        ([Given([0, 0], [0, 0])], 0, []),
    ],
)
def test_directions_count_from_a_hundred_thousandth_of_the_largest(
    trials: list[Given], rank: int, basis: list[list[float]]
) -> None:
    """Singular values are compared within each sample, so that a trial with small ones shows its directions as well."""
    found = _range(trials, FeedbackLayer("inner", nn.Linear(2, 2).double()))  # type: ignore[arg-type]
    assert found is not None
    actions = len(found.basis)
    rows = torch.tensor(basis, dtype=torch.float64).reshape(-1, actions)
    rows /= rows.norm(dim=1, keepdim=True)
    torch.testing.assert_close(found.basis @ found.basis.T, rows.T @ rows)
    assert found.rank == rank


def test_a_small_direction_above_that_is_full_rank() -> None:
    assert _range([Given([1, 0], [0, 3e-5])], FeedbackLayer("inner", nn.Linear(2, 2).double())) is None  # type: ignore[list-item]
