"""The paper's theorems, held against the code.

Theorem 1: the layer-wise cost 1/2 sum_i tr((sigma(i) h(i-1)^T)^T W(i)) that error-driven learning descends differs from
backpropagation's (delta in the place of sigma) by at most d |s| / 2 |e| W_B sqrt(eta), where |W(i)| <= W_B and
|h(i-1)| <= sqrt(eta); the difference is linear in s. Theorem 2: the cost of a fixed target falls. The remark
after it: so does the difference.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from coop.common.networks.network import build_network
from coop.common.types import EnvSpec
from coop.learner.edl.feedback import edl_gradients


def _network(seed: int, actions: int, widths: tuple[int, ...]) -> nn.Sequential:
    return build_network("mlp", EnvSpec("vector", (5,), "float32", 1, actions), widths, seed).double()


def _cost(network: nn.Sequential, x: Tensor, e: Tensor, s: float) -> float:
    gradients = edl_gradients(network, x, e, s)
    weights = {name: p.detach() for name, p in network.named_parameters() if name.endswith("weight")}
    return 0.5 * sum(float((gradients[name] * weight).sum()) for name, weight in weights.items())


def _bound(network: nn.Sequential, x: Tensor, e: Tensor, s: float) -> float:
    """Theorem 1's right-hand side for one state, without the regularisation."""
    norms, sizes, h = [], [], x
    for layer in network:
        if isinstance(layer, nn.Linear):
            norms.append(float(torch.linalg.matrix_norm(layer.weight.detach(), 2)))
            sizes.append(float(h.norm()))
        h = layer(h).detach()
    return len(norms) * abs(s) / 2 * float(e.norm()) * max(norms) * max(sizes)


@settings(max_examples=60)
@given(
    st.integers(0, 2**31),
    st.integers(2, 8),
    st.lists(st.integers(8, 24), min_size=1, max_size=3),
    st.floats(-2, 2),
)
@example(seed=3, actions=3, widths=[8, 9], s=1.0)  # one unit of eight is active: three rows of rank 1
def test_the_costs_differ_by_less_than_theorem_1_says(seed: int, actions: int, widths: list[int], s: float) -> None:
    network = _network(seed, actions, tuple(widths))
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(1, 5, generator=generator, dtype=torch.float64)
    e = torch.randn(1, actions, generator=generator, dtype=torch.float64)
    plain = _cost(network, x, e, 0.0)
    difference = _cost(network, x, e, s) - plain
    rounding = 1e-12 * max(1.0, abs(plain))
    assert abs(difference) <= _bound(network, x, e, s) + rounding
    half = _cost(network, x, e, s / 2) - plain
    assert math.isclose(half, difference / 2, rel_tol=1e-6, abs_tol=rounding)


def test_the_difference_vanishes_in_the_mean() -> None:
    network = _network(3, 4, (16, 16))
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(8, 5, generator=generator, dtype=torch.float64)
    e = torch.randn(8, 4, generator=generator, dtype=torch.float64) / 8
    plain = _cost(network, x, e, 0.0)
    draws = np.random.default_rng(0).standard_normal(300)
    differences = np.array([_cost(network, x, e, float(s)) - plain for s in draws])
    assert differences.std() > 0.01  # each draw does change the cost
    assert abs(differences.mean()) < 4 * differences.std() / math.sqrt(len(draws))


@pytest.mark.parametrize("s", [0.01, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_cost_of_a_fixed_target_falls(s: float, seed: int) -> None:
    """And with it what lies between the two costs, as the remark after theorem 2 says."""
    network = _network(seed, 3, (24, 24))
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(32, 5, generator=generator, dtype=torch.float64)
    target = torch.stack((x.sum(1), x[:, 0] * x[:, 1], x.abs().amax(1)), 1)
    costs, gaps = [], []
    for _ in range(400):
        with torch.no_grad():
            e = (network(x) - target) / len(x)
            costs.append(float(0.5 * len(x) * e.square().sum()))
            if len(costs) % 10 == 1:
                gaps.append(abs(_cost(network, x, e, s) - _cost(network, x, e, 0.0)))
            for name, gradient in edl_gradients(network, x, e, s).items():
                network.get_parameter(name).sub_(gradient, alpha=0.02)
    means = np.array(costs).reshape(8, 50).mean(axis=1)
    assert np.all(np.diff(means) < 0)
    assert means[-1] < 0.4 * means[0]
    assert 0 < np.mean(gaps[-5:]) < 0.4 * np.mean(gaps[:5])
