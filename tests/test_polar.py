"""G^(-1/2) e against an eigenvalue decomposition, and the limits beyond which its results are called inaccurate."""

from typing import Any

import numpy as np
import pytest
import torch

from coop.common.types import Array
from coop.learner.edl.polar import polar, polar_by_svd, polar_of_product, whitened

LIBRARIES = pytest.mark.parametrize("library", [np.asarray, torch.as_tensor])


def _pair(cosine: float, scale: float = 1.0) -> Array:
    return scale * np.array([[1.0, cosine], [cosine, 1.0]])


def _triple(cosine: float) -> Array:
    """Two rows of this cosine, and a third orthogonal to both."""
    return np.block([[_pair(cosine), np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]])


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


def test_a_matrix_on_which_lapack_fails_is_decomposed_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    matrices = torch.randn(3, 6, 5, dtype=torch.float64)
    true_svd = torch.linalg.svd

    def failing(matrix: torch.Tensor, full_matrices: bool) -> tuple[torch.Tensor, ...]:
        """Fails on the second matrix, as LAPACK does on a few that it does not share with other versions of it."""
        if any(torch.equal(each, matrices[1]) for each in matrix.view(-1, 6, 5)):
            raise torch.linalg.LinAlgError("failed to converge")
        return tuple(true_svd(matrix, full_matrices=full_matrices))

    plain = polar_by_svd(matrices)
    monkeypatch.setattr(torch.linalg, "svd", failing)
    factors = polar_by_svd(matrices)
    torch.testing.assert_close(factors[[0, 2]], plain[[0, 2]], rtol=0, atol=1e-14)
    torch.testing.assert_close(factors[1], plain[1], rtol=0, atol=1e-11)
