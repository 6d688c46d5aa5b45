"""G^(-1/2) e against an eigenvalue decomposition, and the limits beyond which its results are called inaccurate."""

from typing import Any

import numpy as np
import pytest
import torch

from coop.common.types import Array
from coop.learner.edl.polar import (
    SCALES,
    _pairing,
    _scales,
    inverse_root,
    newton_schulz,
    polar,
    polar_by_svd,
    polar_of_product,
    whitened,
)

LIBRARIES = pytest.mark.parametrize("library", [np.asarray, torch.as_tensor])


def _pair(cosine: float, scale: float = 1.0) -> Array:
    return scale * np.array([[1.0, cosine], [cosine, 1.0]])


def _triple(cosine: float) -> Array:
    """Two rows of this cosine, and a third orthogonal to both."""
    return np.block([[_pair(cosine), np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]])


def _alike(size: int, cosine: float) -> Array:
    return (1 - cosine) * np.eye(size) + np.full((size, size), cosine)


def _beside(corner: Array) -> Array:
    """Two rows, and two that are orthogonal to all others."""
    return np.block([[corner, np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2)]])


@LIBRARIES
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [2, 3, 5])
def test_whitened(size: int, dtype: type, library: Any) -> None:
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((7, size, 20))
    e = rng.standard_normal((7, size))
    values, vectors = np.linalg.eigh(rows @ rows.swapaxes(1, 2))
    expected = (vectors / values[:, None] ** 0.5 @ vectors.swapaxes(1, 2) @ e[:, :, None])[..., 0]
    gram = library((rows @ rows.swapaxes(1, 2)).astype(dtype))
    white, doubtful = whitened(gram, library(e.astype(dtype)))
    assert doubtful is None
    assert white.dtype == gram.dtype
    np.testing.assert_allclose(white, expected, rtol=1e-4 if dtype is np.float32 else 1e-10, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("size", [2, 3, 4])
def test_whitened_to_float64(size: int, scale: float) -> None:
    rng = np.random.default_rng(0)
    rows = scale * rng.standard_normal((500, size, size)) * rng.uniform(0.3, 1, (500, size, 1))
    gram, e = rows @ rows.swapaxes(1, 2), rng.standard_normal(size)
    white, doubtful = whitened(gram, e)
    assert doubtful is None or doubtful.mean() < 0.02
    values, vectors = np.linalg.eigh(gram)
    expected = np.einsum("bij,bj,bkj,k->bi", vectors, values**-0.5, vectors, e)
    away = np.linalg.norm(white - expected, axis=1) / np.linalg.norm(expected, axis=1)
    inflation = np.einsum("bii,bii->b", gram, np.linalg.inv(gram))
    sound = np.ones(500, bool) if doubtful is None else ~doubtful
    assert (away / inflation)[sound].max() < 1e-13


def _grams(*smallest: float) -> torch.Tensor:
    """Gram matrices of 4 x 4, whose smallest eigenvalue is this share of the largest."""
    generator = torch.Generator().manual_seed(0)
    vectors = torch.linalg.qr(torch.randn(len(smallest), 4, 4, generator=generator, dtype=torch.float64))[0]
    values = torch.tensor([[each, 0.2, 0.7, 1.0] for each in smallest], dtype=torch.float64)
    return (vectors * values[:, None]) @ vectors.mT


@pytest.mark.parametrize("root", [inverse_root, newton_schulz])
@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_inverse_roots(root: Any, scale: float) -> None:
    grams = scale * _grams(0.5, 1e-3, 1e-6, 4e-10).reshape(2, 2, 4, 4)
    found = root(grams)
    units = torch.eye(4, dtype=torch.float64).expand(2, 2, 4, 4)
    torch.testing.assert_close(found, found.mT, rtol=1e-5, atol=1e-5 * scale**-0.5)
    whole = found @ grams @ found
    torch.testing.assert_close(whole[0], units[0], rtol=0, atol=1e-8)
    torch.testing.assert_close(whole[1, 0], units[0, 0], rtol=0, atol=1e-7)
    torch.testing.assert_close(whole[1, 1], units[0, 0], rtol=0, atol=1e-4)


def test_a_gram_matrix_that_is_not_finite_has_no_inverse_root() -> None:
    grams = _grams(0.5, 0.4, 0.3, 0.2).reshape(2, 2, 4, 4)
    expected = inverse_root(grams)
    grams[0, 1, 2, 3] = torch.nan
    found = inverse_root(grams)
    assert found[0, 1].isnan().all()
    torch.testing.assert_close(found[0, 0], expected[0, 0])
    torch.testing.assert_close(found[1], expected[1])


def test_the_scales_bring_every_root_to_1() -> None:
    """Each is the best for the smallest of the roots, as long as it is stable; one fewer would not be enough."""
    assert _scales() == SCALES

    def after(x: Array, scales: list[float]) -> Array:
        for rho in scales:
            x = 0.5 * rho * x * (3 - rho**2 * x**2)
        return x

    roots = np.geomspace(1e-5, 1, 1000)
    assert np.abs(after(roots, SCALES) - 1).max() < 1e-12
    assert np.abs(after(roots, SCALES[:-2]) - 1).max() > 1e-9
    assert max(SCALES) == 1.6977
    assert SCALES[-1] == 1
    for k, rho in enumerate(SCALES[:-1]):
        smallest = after(roots[:1], SCALES[:k])[0]
        assert rho == min((3 / (1 + smallest + smallest**2)) ** 0.5, 1.6977)


@LIBRARIES
@pytest.mark.parametrize(
    ("gram", "accurate"),
    [
        # Nearly parallel rows of any length: the inflation factors, 2 / (1 - cos^2) in all, may reach 300 ...
        *((_pair((1 - 0.0075) ** 0.5, scale), True) for scale in (0.25, 1.0, 4.0)),
        *((_pair((1 - 0.0060) ** 0.5, scale), False) for scale in (0.25, 1.0, 4.0)),
        # ... and one is that of a row orthogonal to all others.
        (_triple((1 - 0.0072) ** 0.5), True),
        (_triple((1 - 0.0064) ** 0.5), False),
        # The squared length of the shortest row must be above 1e-31 ...
        (np.diag([1.0, 1.2e-31]), True),
        (np.diag([1.2e-31, 1.0]), True),
        (np.diag([1.0, 0.8e-31]), False),
        (np.diag([4.0, 0.8e-31]), False),
        (np.diag([0.8e-31, 1.0]), False),
        (1.2e-31 * np.eye(3), True),
        (0.8e-31 * np.eye(3), False),
        # ... and with three rows, 1e-11 of the longest one's.
        (np.diag([1.0, 1.2e-11, 1.0]), True),
        (np.diag([1.0, 0.8e-11, 1.0]), False),
        (np.diag([0.8e-11, 0.8e-11, 1.0]), False),
        (np.full((2, 2), np.nan), False),
        (np.full((3, 3), np.nan), False),
        # Three rows that are all nearly parallel.
        (_alike(3, 0.992), True),
        (_alike(3, 0.990), True),
        (_alike(3, 0.994), False),
        # More rows, by eigenvalues.
        (_beside(_pair((1 - 0.0075) ** 0.5)), True),
        (_beside(_pair((1 - 0.0060) ** 0.5)), False),
        (_beside(np.diag([1.0, 1.2e-11])), True),
        (4 * _beside(np.diag([1.0, 0.8e-11])), False),
        (_beside(np.diag([0.8e-31, 1.0])), False),
        (_beside(np.full((2, 2), np.nan)), False),
    ],
)
def test_what_float32_is_too_coarse_for_is_named_and_left_at_0(gram: Array, accurate: bool, library: Any) -> None:
    half, three = 0.5 * np.eye(len(gram)), 3 * np.eye(len(gram))
    grams = np.array([[half, gram, three], [half, half, three]], np.float32)  # of two layers
    e = np.ones((3, len(gram)), np.float32)
    with np.errstate(invalid="ignore"):
        white, doubtful = whitened(library(grams), library(e))
    if accurate:
        assert doubtful is None
        assert (np.asarray(white[0, 1]) != 0).any()
    else:
        assert np.asarray(doubtful).tolist() == [[False, True, False], [False] * 3]
        assert (np.asarray(white[0, 1]) == 0).all()
    for layer in (0, 1):
        np.testing.assert_allclose(white[layer, 0], e[0] * 2**0.5, rtol=1e-6)
        np.testing.assert_allclose(white[layer, 2], e[0] / 3**0.5, rtol=1e-6)


@LIBRARIES
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("size", "rank"), [(2, 1), (3, 1), (3, 2), (4, 1), (4, 3)])
def test_no_matrix_that_lacks_rank_passes_for_accurate(size: int, rank: int, dtype: type, library: Any) -> None:
    rng = np.random.default_rng(0)
    rows = (rng.standard_normal((20_000, size, rank)) @ rng.standard_normal((20_000, rank, 6))).astype(dtype)
    gram, e = np.einsum("bij,bkj->bik", rows, rows), np.eye(size, dtype=dtype)[0]
    with np.errstate(all="ignore"):
        white, doubtful = whitened(library(gram), library(e))
    assert doubtful is not None
    assert np.asarray(doubtful).all()
    assert not np.asarray(white).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(3, 5), (5, 3), (12, 20), (20, 12)])
def test_polar_factors_keep_shape_and_dtype_and_what_is_not_finite(shape: tuple[int, int], dtype: torch.dtype) -> None:
    rng = np.random.default_rng(0)
    matrix = torch.from_numpy(rng.standard_normal(shape)).to(dtype)
    left, right = (torch.from_numpy(rng.standard_normal((2, n))).to(dtype) for n in shape)
    for factor in (polar(matrix, rng), polar_of_product(left, right, rng)):
        assert (factor.shape, factor.dtype) == (shape, dtype)
        units = torch.linalg.svdvals(factor.double())
        torch.testing.assert_close(units, torch.ones_like(units), rtol=1e-5, atol=1e-5)
    matrix[1, 2], left[0, 1] = torch.inf, torch.nan
    for factor in (polar(matrix, rng), polar_of_product(left, right, rng)):
        assert (factor.shape, factor.dtype) == (shape, dtype)
        assert factor.isnan().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rank", [None, 1])
def test_polar_factors_by_svd(rank: int | None, dtype: torch.dtype) -> None:
    matrices = torch.from_numpy(np.random.default_rng(0).standard_normal((3, 2, 4))).to(dtype)
    u, _, vh = torch.linalg.svd(matrices.double(), full_matrices=False)
    expected = (u[..., :rank] @ vh[..., :rank, :]).to(dtype)
    factors = polar_by_svd(matrices, rank)
    assert factors.dtype == dtype
    torch.testing.assert_close(factors, expected)
    matrices[1, 0, 2] = torch.inf
    broken = polar_by_svd(matrices, rank)
    assert broken[1].isnan().all()
    torch.testing.assert_close(broken[[0, 2]], expected[[0, 2]])


def test_a_matrix_of_0_gets_a_factor_by_chance() -> None:
    def factors(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        rng = np.random.default_rng(seed)
        return polar(torch.zeros(3, 5), rng), polar_of_product(torch.zeros(2, 3), torch.zeros(2, 5), rng)

    for one, other in zip(factors(0), factors(1), strict=True):
        assert not torch.equal(one, other)
        torch.testing.assert_close(one @ one.t(), torch.eye(3))


@pytest.mark.parametrize(("dtype", "accurate"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("shape", [(5, 9), (9, 5), (6, 6)])
@pytest.mark.parametrize("lost", [0, 1, 2])
def test_blocks_of_reflections_are_the_reflections_one_by_one(
    lost: int, shape: tuple[int, int], dtype: torch.dtype, accurate: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Samples without error are columns of 0, whose reflections are none."""
    generator = torch.Generator().manual_seed(lost)
    left, right = (torch.randn(4, n, generator=generator, dtype=dtype) for n in shape)
    left[:lost], right[2] = 0, right[3]
    found = []
    for limit in (0, 1000):
        monkeypatch.setattr("coop.learner.edl.polar._BLOCKED", limit)
        found.append(polar_of_product(left, right, np.random.default_rng(lost)))
    torch.testing.assert_close(*found, rtol=0, atol=accurate)
    assert not torch.equal(*found), "one path for both"
    short = found[0] if shape[0] <= shape[1] else found[0].t()
    torch.testing.assert_close(short @ short.t(), torch.eye(len(short), dtype=dtype), rtol=0, atol=accurate)


def test_each_null_direction_has_a_sign_of_its_own() -> None:
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(50):
        columns, signs = (each.tolist() for each in _pairing(3, 4, 1, rng))
        assert (columns[0], signs[0]) == (0, 1)
        assert len(set(columns)) == 3
        assert set(columns) <= set(range(4))
        seen.add(tuple(signs[1:]))
    assert seen == {(1, 1), (1, -1), (-1, 1), (-1, -1)}


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("batch", [2, 3])
def test_a_matrix_on_which_lapack_fails_is_decomposed_all_the_same(
    batch: int, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = torch.Generator().manual_seed(0)
    matrices = scale * torch.randn(batch, 6, 5, generator=generator, dtype=torch.float64)
    true_svd = torch.linalg.svd

    def failing(matrix: torch.Tensor, full_matrices: bool) -> tuple[torch.Tensor, ...]:
        """Fails on the second matrix, as LAPACK does on a few that it does not share with other versions of it."""
        if any(torch.equal(each, matrices[1]) for each in matrix.view(-1, 6, 5)):
            raise torch.linalg.LinAlgError("failed to converge")
        return tuple(true_svd(matrix, full_matrices=full_matrices))

    plain = polar_by_svd(matrices)
    monkeypatch.setattr(torch.linalg, "svd", failing)
    factors = polar_by_svd(matrices)
    torch.testing.assert_close(factors[::2], plain[::2], rtol=0, atol=1e-14)
    torch.testing.assert_close(factors[1], plain[1], rtol=0, atol=1e-11)
