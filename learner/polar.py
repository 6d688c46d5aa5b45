"""Orthogonal polar factors U V^T of matrices U S V^T, without an SVD wherever that is accurate."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class _Limits:
    """Which Gram matrices can be trusted.

    square: the shortest row's squared length. inflation: the largest sum of variance inflation factors (see
    `whitened`). ratio: the smallest ratio of two eigenvalues.
    """

    square: float
    inflation: float
    ratio: float


_LIMITS = {torch.float32: _Limits(1e-31, 3e2, 1e-11), torch.float64: _Limits(1e-292, 1e6, 1e-9)}


def whitened(gram: Tensor, e: Tensor) -> tuple[Tensor, Tensor | None]:
    """G^(-1/2) e, and where it can't be trusted and is 0: ([..., m, k], bool [...], None if that is nowhere).

    gram: float32 or float64 [..., m, m], Gram matrices of matrices in that dtype. e: [..., m, k], broadcast. The
    algebra is done in float64, so what limits the accuracy is the rounding of gram's entries, eps |t_i| |t_j|. With C
    the matrix G scaled to a unit diagonal, the polar factor's relative error is about
    eps |C^(-1)| <= eps sum_i (C^(-1))_ii: rows of very different length do no harm, rows that are nearly parallel do.
    Those sums are the variance inflation factors of statistics.
    """
    whiten = _whitened_pairs if gram.shape[-1] == 2 else _whitened_by_eigh
    white, safe = whiten(gram.double(), e.double(), _LIMITS[gram.dtype])
    if safe.all():
        return white.to(gram.dtype), None
    return white.masked_fill_(~safe[..., None, None], 0).to(gram.dtype), ~safe


def _whitened_pairs(g: Tensor, e: Tensor, limits: _Limits) -> tuple[Tensor, Tensor]:
    """The closed form for 2 x 2: G^(-1/2) = ((t + d) I - G) / (d sqrt(t + 2 d)) with d^2 = det G and t = tr G."""
    a, c, _, b = g.flatten(-2).unsqueeze(-1).unbind(-2)
    e1, e2 = e.unbind(-2)
    product = a * b
    determinant = torch.addcmul(product, c, c, value=-1)
    # Both inflation factors are product / determinant.
    safe = determinant >= product * (2 / limits.inflation)
    safe &= torch.minimum(a, b) > limits.square  # also False for nan
    d = determinant.sqrt_()
    scale = torch.add(a + b, d, alpha=2).sqrt_().mul_(d)
    first = ((b + d) * e1).addcmul_(c, e2, value=-1).div_(scale)
    second = ((a + d) * e2).addcmul_(c, e1, value=-1).div_(scale)
    return torch.stack((first, second), -2), safe.squeeze(-1)


def _whitened_by_eigh(g: Tensor, e: Tensor, limits: _Limits) -> tuple[Tensor, Tensor]:
    diagonal = g.diagonal(dim1=-2, dim2=-1)
    safe = g.isfinite().all(-1).all(-1) & (diagonal.amin(-1) > limits.square)
    values, vectors = torch.linalg.eigh(g if safe.all() else g.masked_fill(~safe[..., None, None], 0))
    safe &= values[..., 0] > limits.ratio * values[..., -1]
    inverse = values.clamp_min(limits.square).reciprocal()
    inflation = (diagonal * (vectors.square() * inverse.unsqueeze(-2)).sum(-1)).sum(-1)
    safe &= inflation <= limits.inflation
    return vectors @ (inverse.sqrt().unsqueeze(-1) * (vectors.mT @ e)), safe


def polar_by_svd(matrices: Tensor) -> Tensor:
    """U V^T of each matrix [batch, m, n], computed in float64; nan where a matrix is not finite.

    All min(m, n) singular values of the result are 1: where a matrix lacks rank, LAPACK's U and V complete it with an
    orthonormal basis of the null directions, which depends on nothing but the matrix.
    """
    finite = matrices.isfinite().flatten(1).all(1)[:, None, None]
    u, _, vh = torch.linalg.svd(matrices.double().masked_fill(~finite, 0), full_matrices=False)
    factor: Tensor = u @ vh
    return factor.to(matrices.dtype).masked_fill_(~finite, torch.nan)
