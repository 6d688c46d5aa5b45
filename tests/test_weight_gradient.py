"""The weight-gradient feedback: U (S + s I) V^T of each layer's weight gradient, without an SVD of it."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from coop.common.networks.network import build_network
from coop.common.types import EnvSpec
from coop.learner.edl.feedback import edl_gradients
from coop.learner.edl.polar import polar, polar_of_product

S = 0.3
RNG = np.random.default_rng(0)


def _network(kind: str, actions: int) -> tuple[nn.Sequential, tuple[int, ...]]:
    mlp = kind == "mlp"
    spec = EnvSpec("x", (4,) if mlp else (84, 84), "float32" if mlp else "uint8", 1 if mlp else 4, actions)
    return build_network(kind, spec, (64, 48), 0).double(), spec.obs_shape


def _is_polar_factor(factor: Tensor, matrix: Tensor, tolerance: float) -> bool:
    """Orthonormal along the shorter side, and P^T M (or M P^T) symmetric and positive semidefinite.

    That is what makes M = P (P^T M) a polar decomposition, also where M lacks rank and P is one of many.
    """
    if factor.shape[0] < factor.shape[1]:
        factor, matrix = factor.T, matrix.T
    units = torch.eye(factor.shape[1], dtype=factor.dtype)
    product = factor.T @ matrix
    scale = float(torch.linalg.matrix_norm(matrix, 2)) or 1.0
    return bool(
        (factor.T @ factor - units).abs().max() < tolerance
        and (product - product.T).abs().max() < tolerance * scale
        and torch.linalg.eigvalsh((product + product.T) / 2).min() > -tolerance * scale
    )


@pytest.mark.parametrize(
    ("kind", "actions", "batch"), [("mlp", 2, 1), ("mlp", 6, 32), ("nips2013", 4, 8), ("nature", 6, 3)]
)
def test_each_weight_gradient_gets_a_polar_factor(kind: str, actions: int, batch: int) -> None:
    network, shape = _network(kind, actions)
    generator = torch.Generator().manual_seed(1)
    x = torch.rand(batch, *shape, generator=generator, dtype=torch.float64)
    e = torch.randn(batch, actions, generator=generator, dtype=torch.float64) / batch
    plain, fed = edl_gradients(network, x, e, 0.0), edl_gradients(network, x, e, S, "weight-gradient")
    for name, gradient in plain.items():
        if name.endswith("bias"):
            assert torch.equal(fed[name], gradient)
        else:
            assert _is_polar_factor((fed[name] - gradient).flatten(1) / S, gradient.flatten(1), 1e-6)


def test_in_bfloat16_a_gradient_of_few_samples_is_the_same_up_to_rounding() -> None:
    """The batch is smaller than the layers, so the factor comes from the product, by a QR that bfloat16 lacks."""
    network, x, e = _network("mlp", 3)[0].float(), *torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(1))
    exact = edl_gradients(network, x, e[:, :3], S, "weight-gradient")
    half = edl_gradients(network.bfloat16(), x.bfloat16(), e[:, :3].bfloat16(), S, "weight-gradient")
    for name, gradient in exact.items():
        assert half[name].dtype == torch.bfloat16
        assert 1e-4 < float((half[name].float() - gradient).norm() / gradient.norm()) < 0.03


@pytest.mark.parametrize("s", [S, 1.0])
def test_where_the_gradient_has_full_rank_it_is_the_svd(s: float) -> None:
    network, shape = _network("mlp", 6)
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(256, *shape, generator=generator, dtype=torch.float64)
    e = torch.randn(256, 6, generator=generator, dtype=torch.float64) / 256
    plain, fed = edl_gradients(network, x, e, 0.0), edl_gradients(network, x, e, s, "weight-gradient")
    ranks = []
    for name, gradient in plain.items():
        if name.endswith("weight"):
            u, values, vt = torch.linalg.svd(gradient, full_matrices=False)
            ranks.append(float(values[-1] / values[0]))
            if ranks[-1] > 1e-6:
                torch.testing.assert_close(fed[name], u @ torch.diag(values + s) @ vt, rtol=1e-6, atol=1e-8)
    assert max(ranks) > 1e-6


@settings(max_examples=settings.default.max_examples // 2)
@given(st.integers(0, 2**31), st.integers(1, 40), st.integers(1, 40), st.integers(0, 40))
def test_any_matrix(seed: int, rows: int, columns: int, rank: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    left = torch.randn(rank, rows, generator=generator, dtype=torch.float64)
    right = torch.randn(rank, columns, generator=generator, dtype=torch.float64)
    assert _is_polar_factor(polar(left.T @ right, RNG), left.T @ right, 1e-6)
    if 0 < rank < min(rows, columns):
        assert _is_polar_factor(polar_of_product(left, right, RNG), left.T @ right, 1e-6)
        single = polar_of_product(left.float(), right.float(), RNG).double()
        assert _is_polar_factor(single, left.T @ right, 1e-4)


def test_batches_of_equal_samples_and_of_zero_error_are_harmless() -> None:
    network, shape = _network("mlp", 3)
    x = torch.ones(16, *shape, dtype=torch.float64)
    for e in (torch.zeros(16, 3, dtype=torch.float64), torch.full((16, 3), 0.1, dtype=torch.float64)):
        for gradient in edl_gradients(network, x, e, S, "weight-gradient").values():
            assert gradient.isfinite().all()


def _of_rank(rank: int, rows: int, columns: int) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Factors of a matrix left^T right whose last samples repeat the first ones, and its U and V^T by LAPACK."""
    generator = torch.Generator().manual_seed(rank)
    left, right = (torch.randn(rank, n, generator=generator, dtype=torch.float64) for n in (rows, columns))
    left, right = (torch.cat((x, x[: rank // 2])) for x in (left, right))
    u, _, vh = torch.linalg.svd(left.T @ right, full_matrices=False)
    return left, right, (u[:, :rank], vh[:rank])


@pytest.mark.parametrize(("rank", "rows", "columns"), [(8, 24, 24), (6, 20, 31), (10, 31, 20), (4, 9, 5), (10, 12, 30)])
def test_null_directions_are_paired_without_a_bias(rank: int, rows: int, columns: int) -> None:
    """Where singular values are above rounding it is LAPACK's U V^T; the rest has mean 0 and is spread evenly."""
    left, right, (u, vh) = _of_rank(rank, rows, columns)
    draws = 600
    rests = []
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        by_product = len(left) < min(rows, columns)
        factor = polar_of_product(left, right, rng) if by_product else polar(left.T @ right, rng)
        rests.append(factor - u @ vh)
    rest = torch.stack(rests)
    missing = min(rows, columns) - rank
    torch.testing.assert_close(u.T @ rest, torch.zeros(draws, rank, columns, dtype=rest.dtype), atol=1e-8, rtol=0)
    torch.testing.assert_close(rest @ vh.T, torch.zeros(draws, rows, rank, dtype=rest.dtype), atol=1e-8, rtol=0)
    sizes = rest.square().sum((1, 2))
    torch.testing.assert_close(sizes, torch.full_like(sizes, missing))
    # The squared norm of the mean of so many independent draws; a fixed pairing has `missing`.
    assert 0.7 < draws * float(rest.mean(0).square().sum()) / missing < 1.4


def test_completions_of_a_rule_come_from_its_generator() -> None:
    network, shape = _network("mlp", 3)
    x, e = torch.ones(16, *shape, dtype=torch.float64), torch.full((16, 3), 0.1, dtype=torch.float64)
    first, again, other = (edl_gradients(network, x, e, S, "weight-gradient", seed=seed) for seed in (0, 0, 1))
    name = [name for name in first if name.endswith("weight")][1]
    assert torch.equal(first[name], again[name])
    assert (first[name] - other[name]).abs().max() > 0.01
