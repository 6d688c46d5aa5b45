"""Polar factors of a batch's T(i) beside those by SVD: of full rank, completed, and thin; computed exactly or not."""

import pytest
import torch
from torch import Tensor

from coop.learner.edl.backprop import Subspace
from coop.learner.edl.completed import Jacobians, independent

DOUBLE, SINGLE = torch.float64, torch.float32
LARGE = 2**17 + 2  # columns with which two rows have more than 2^18 numbers
PRECISIONS = pytest.mark.parametrize(
    ("width", "dtype", "exact"), [(40, SINGLE, True), (40, DOUBLE, True), (LARGE, DOUBLE, True), (LARGE, SINGLE, False)]
)


def rows(width: int, sine: float, scale: float = 1.0) -> Tensor:
    """Two rows [1, 2, width], of lengths scale and 2 scale, between which the angle has this sine."""
    generator = torch.Generator().manual_seed(0)
    one, other = torch.linalg.qr(torch.randn(width, 2, generator=generator, dtype=DOUBLE))[0].mT
    return scale * torch.stack([one, 2 * ((1 - sine**2) ** 0.5 * one + sine * other)])[None]


def polar(t: Tensor) -> Tensor:
    u, _, vh = torch.linalg.svd(t.double(), full_matrices=False)
    return u @ vh


def factor(t: Tensor, batch: int | None = None, reach: Subspace | None = None, within: float = 1e-4) -> Tensor:
    """P of each sample, by the matrices of s = 1 and 0, with which `apply` must agree."""
    jacobians = Jacobians([t], [reach], torch.eye(t.shape[1], dtype=DOUBLE), batch or len(t))
    found, plain = (jacobians.matrices(s)[0] for s in (1.0, 0.0))
    assert found.dtype == t.dtype
    torch.testing.assert_close(plain, t.expand(plain.shape))
    e = torch.linspace(-1, 2, found.shape[0] * t.shape[1]).reshape(-1, t.shape[1]).to(t.dtype)
    sigma = jacobians.apply(e, 1.0)[0]
    assert sigma.dtype == t.dtype
    expected = (e[:, :, None] * found).sum(1)
    torch.testing.assert_close(sigma, expected, rtol=within, atol=within * float(found.abs().max()))
    return found.double() - plain.double()


def assert_orthonormal(p: Tensor, within: float) -> None:
    units = torch.linalg.svdvals(p)
    torch.testing.assert_close(units, torch.ones_like(units), rtol=0, atol=within)


@PRECISIONS
def test_independent_rows(width: int, dtype: torch.dtype, exact: bool) -> None:
    t = rows(width, 0.5)
    torch.testing.assert_close(factor(t.to(dtype)), polar(t), rtol=0, atol=1e-6 if exact else 1e-5)


@PRECISIONS
def test_rows_that_are_nearly_parallel(width: int, dtype: torch.dtype, exact: bool) -> None:
    """The polar factor itself where it can be told; where G is too coarse, orthonormal rows to about delta."""
    t = rows(width, 1e-3)
    p = factor(t.to(dtype))
    assert_orthonormal(p, 1e-3 if exact else 2e-2)
    away = float((p - polar(t)).norm())
    assert away < 1e-3 if exact else away > 0.1


@PRECISIONS
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_parallel_rows(width: int, dtype: torch.dtype, exact: bool, scale: float) -> None:
    """What T has stays, and the rest of P is a unit vector orthogonal to it."""
    t = torch.cat([rows(width, 0.0, scale), rows(width, 0.0, scale / 1e4)]).to(dtype)
    close = exact and dtype == DOUBLE
    p = factor(t, within=1e-4 if close else 1e-2)
    assert_orthonormal(p, 1e-4 if close else 2e-2)
    u, _, vh = torch.linalg.svd(t.double(), full_matrices=False)
    kept = (u[:, :, :1].mT @ p)[:, 0]
    assert float((kept - vh[:, 0]).norm(dim=1).max()) < (1e-4 if close else 5e-2)


@pytest.mark.parametrize("width", [1, 2, 3])
@pytest.mark.parametrize("actions", [1, 2, 3])
def test_a_layer_that_is_dead(actions: int, width: int) -> None:
    """T = 0 gets orthonormal rows where they fit, and no feedback where they don't."""
    p = factor(torch.zeros(2, actions, width, dtype=DOUBLE))
    if width < actions:
        assert not p.any()
    else:
        assert_orthonormal(p, 1e-4)


@pytest.mark.parametrize(("batch", "dtype", "within"), [(5, DOUBLE, 1e-6), (5, SINGLE, 1e-5), (2**16, SINGLE, 1e-3)])
def test_the_thin_factor_of_a_narrow_layer(batch: int, dtype: torch.dtype, within: float) -> None:
    t = torch.tensor([[1.0, 0.2], [0.3, -1.0], [0.5, 0.7]], dtype=DOUBLE)
    p = factor(t.expand(batch, 3, 2).contiguous().to(dtype))
    torch.testing.assert_close(p, polar(t).expand(p.shape), rtol=0, atol=within)


@pytest.mark.parametrize("width", [3, 7])
@pytest.mark.parametrize("dead", [False, True])
def test_a_layer_that_reaches_a_part_of_the_actions(width: int, dead: bool) -> None:
    """Of rank 2 in the subspace of three actions whose sum is 0: P has two singular values of 1, and stays in it."""
    basis = torch.linalg.qr(torch.eye(3, dtype=DOUBLE)[:, :2] - 1 / 3)[0]
    reach = Subspace(basis, 2)
    t = basis @ torch.randn(4, 2, width, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    t = torch.zeros_like(t) if dead else t
    p = factor(t.float(), reach=reach)
    units = torch.linalg.svdvals(p)
    torch.testing.assert_close(units, torch.tensor([1.0, 1, 0], dtype=DOUBLE).expand(4, 3), rtol=0, atol=1e-4)
    torch.testing.assert_close(p.sum(1), torch.zeros(4, width, dtype=DOUBLE), rtol=0, atol=1e-4)
    if not dead:
        u, _, vh = torch.linalg.svd(t, full_matrices=False)
        torch.testing.assert_close(p, u[:, :, :2] @ vh[:, :2], rtol=0, atol=1e-4)


@pytest.mark.parametrize("actions", [2, 3])
def test_a_layer_that_all_samples_share(actions: int) -> None:
    t = torch.randn(1, actions, 5, generator=torch.Generator().manual_seed(2), dtype=DOUBLE)
    torch.testing.assert_close(factor(t, batch=3), polar(t).expand(3, actions, 5), rtol=0, atol=1e-6)


def test_what_counts_as_independent() -> None:
    """Of the second row's squared length 2, 1 is orthogonal to the first: more than the limit, or not."""
    gram = torch.tensor([[4.0, 2.0], [2.0, 2.0]])
    assert independent(gram, 0.49)
    assert not independent(gram, 0.5)
    assert not independent(torch.zeros(1, 1), 0.5)
    assert independent(torch.ones(1, 1), 0.5)
    many = independent(torch.stack([gram, torch.full((2, 2), torch.nan), torch.ones(2, 2), torch.zeros(2, 2)]), 1e-8)
    assert many.tolist() == [True, False, False, False]
