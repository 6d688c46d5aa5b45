"""The weight-gradient feedback: U (S + s I) V^T of each layer's weight gradient, without an SVD of it."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from common.networks.network import build_network
from common.types import EnvSpec
from learner.edl.feedback import edl_gradients
from learner.edl.polar import polar, polar_of_product

S = 0.3


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


def test_where_the_gradient_has_full_rank_it_is_the_svd() -> None:
    network, shape = _network("mlp", 6)
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(256, *shape, generator=generator, dtype=torch.float64)
    e = torch.randn(256, 6, generator=generator, dtype=torch.float64) / 256
    plain, fed = edl_gradients(network, x, e, 0.0), edl_gradients(network, x, e, S, "weight-gradient")
    ranks = []
    for name, gradient in plain.items():
        if name.endswith("weight"):
            u, values, vt = torch.linalg.svd(gradient, full_matrices=False)
            ranks.append(float(values[-1] / values[0]))
            if ranks[-1] > 1e-6:
                torch.testing.assert_close(fed[name], u @ torch.diag(values + S) @ vt, rtol=1e-6, atol=1e-8)
    assert max(ranks) > 1e-6


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(1, 40), st.integers(1, 40), st.integers(0, 40))
def test_any_matrix(seed: int, rows: int, columns: int, rank: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    left = torch.randn(rank, rows, generator=generator, dtype=torch.float64)
    right = torch.randn(rank, columns, generator=generator, dtype=torch.float64)
    assert _is_polar_factor(polar(left.T @ right), left.T @ right, 1e-6)
    if 0 < rank < min(rows, columns):
        assert _is_polar_factor(polar_of_product(left, right), left.T @ right, 1e-6)
        single = polar_of_product(left.float(), right.float()).double()
        assert _is_polar_factor(single, left.T @ right, 1e-4)


def test_batches_of_equal_samples_and_of_zero_error_are_harmless() -> None:
    network, shape = _network("mlp", 3)
    x = torch.ones(16, *shape, dtype=torch.float64)
    for e in (torch.zeros(16, 3, dtype=torch.float64), torch.full((16, 3), 0.1, dtype=torch.float64)):
        for gradient in edl_gradients(network, x, e, S, "weight-gradient").values():
            assert gradient.isfinite().all()
