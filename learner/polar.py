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
    """G^(-1/2) e, and where that is doubtful and 0 was put: ([..., m], bool [...] or None for nowhere).

    gram: float32 or float64 [..., m, m], Gram matrices of matrices in that dtype. e: [..., m], broadcast. The
    algebra is done in float64, so what limits the accuracy is the rounding of gram's entries, eps |t_i| |t_j|. With C
    the matrix G scaled to a unit diagonal, the polar factor's relative error is about
    eps |C^(-1)| <= eps sum_i (C^(-1))_ii: rows of very different length do no harm, rows that are nearly parallel do.
    Those sums are the variance inflation factors of statistics.
    """
    whiten = _whitened_pairs if gram.shape[-1] == 2 else _whitened_by_eigh
    white, doubtful = whiten(gram.double(), e.double(), _LIMITS[gram.dtype])
    if doubtful is not None:
        white.masked_fill_(doubtful.unsqueeze(-1), 0)
    return white.to(gram.dtype), doubtful


def _whitened_pairs(g: Tensor, e: Tensor, limits: _Limits) -> tuple[Tensor, Tensor | None]:
    """The closed form for 2 x 2: G^(-1/2) = ((t + d) I - G) / (d sqrt(t + 2 d)) with d^2 = det G and t = tr G."""
    a, c, _, b = g.flatten(-2).unbind(-1)
    first, second = e.unbind(-1)
    product, trace = a * b, a + b
    determinant = torch.addcmul(product, c, c, value=-1)
    # Both variance inflation factors are product / determinant; determinant / trace is below the shorter row's square.
    margin = torch.sub(determinant, product, alpha=2 / limits.inflation).sub_(trace, alpha=limits.square)
    doubtful = None if float(margin.min()) > 0 else (margin > 0).logical_not_()
    d = determinant.sqrt_()
    scale = torch.add(trace, d, alpha=2).sqrt_().mul_(d)
    white = ((b + d) * first).addcmul_(c, second, value=-1), ((a + d) * second).addcmul_(c, first, value=-1)
    return torch.stack(white, -1).div_(scale.unsqueeze(-1)), doubtful


def _whitened_by_eigh(g: Tensor, e: Tensor, limits: _Limits) -> tuple[Tensor, Tensor | None]:
    diagonal = g.diagonal(dim1=-2, dim2=-1)
    safe = g.isfinite().all(-1).all(-1) & (diagonal.amin(-1) > limits.square)
    values, vectors = torch.linalg.eigh(g if safe.all() else g.masked_fill(~safe[..., None, None], 0))
    safe &= values[..., 0] > limits.ratio * values[..., -1]
    inverse = values.clamp_min(limits.square).reciprocal()
    inflation = (diagonal * (vectors.square() * inverse.unsqueeze(-2)).sum(-1)).sum(-1)
    safe &= inflation <= limits.inflation
    white = vectors @ (inverse.sqrt() * (vectors.mT @ e.unsqueeze(-1)).squeeze(-1)).unsqueeze(-1)
    return white.squeeze(-1), None if safe.all() else ~safe


def polar_by_svd(matrices: Tensor) -> Tensor:
    """U V^T of each matrix [batch, m, n], computed in float64; nan where a matrix is not finite.

    All min(m, n) singular values of the result are 1: where a matrix lacks rank, LAPACK's U and V complete it with an
    orthonormal basis of the null directions, which depends on nothing but the matrix.
    """
    finite = matrices.isfinite().flatten(1).all(1)[:, None, None]
    u, _, vh = torch.linalg.svd(matrices.double().masked_fill(~finite, 0), full_matrices=False)
    factor: Tensor = u @ vh
    return factor.to(matrices.dtype).masked_fill_(~finite, torch.nan)
