"""Orthogonal polar factors U V^T of matrices U S V^T, without an SVD wherever that is accurate."""

from __future__ import annotations

import torch
from torch import Tensor

# How far a Gram matrix in this dtype may be from orthogonal rows: the largest sum of variance inflation factors
# (see `inverse_root`), and the smallest ratio of its eigenvalues.
_MOST_INFLATION = {torch.float32: 3e2, torch.float64: 1e6}
_LEAST_RATIO = {torch.float32: 1e-11, torch.float64: 1e-9}


def inverse_root(gram: Tensor) -> tuple[Tensor, Tensor]:
    """G^(-1/2) of Gram matrices, and where it can be trusted: ([..., m, m], bool [...]), zeros where it can't.

    gram: float32 or float64 [..., m, m] of matrices in that dtype. The algebra is done in float64, so what limits the
    accuracy is the rounding of gram's entries, eps |t_i| |t_j|. With C the matrix G scaled to a unit diagonal, the
    polar factor's relative error is about eps |C^(-1)| <= eps sum_i (C^(-1))_ii: rows of very different length do no
    harm, rows that are nearly parallel do. Those sums are the variance inflation factors of statistics.
    """
    g = gram.double()
    info = torch.finfo(gram.dtype)
    diagonal = g.diagonal(dim1=-2, dim2=-1)
    safe = diagonal.amin(-1) > info.tiny / info.eps  # also False for nan
    if gram.shape[-1] == 2:
        root, inflation = _inverse_root_of_pairs(g)
    else:
        safe &= g.isfinite().all(-1).all(-1)
        values, vectors = torch.linalg.eigh(g.masked_fill(~safe[..., None, None], 0))
        safe &= values[..., 0] > _LEAST_RATIO[gram.dtype] * values[..., -1]
        values = values.clamp_min(info.tiny)
        root = (vectors * values.rsqrt().unsqueeze(-2)) @ vectors.mT
        inflation = (diagonal * (vectors.square() / values.unsqueeze(-2)).sum(-1)).sum(-1)
    safe &= inflation <= _MOST_INFLATION[gram.dtype]
    if not safe.all():
        root.masked_fill_(~safe[..., None, None], 0)
    return root.to(gram.dtype), safe


def _inverse_root_of_pairs(g: Tensor) -> tuple[Tensor, Tensor]:
    """The closed form for 2 x 2: G^(-1/2) = ((t + d) I - G) / (d sqrt(t + 2 d)) with d^2 = det G and t = tr G."""
    a, c, _, b = g.flatten(-2).unbind(-1)
    product = a * b
    determinant = torch.addcmul(product, c, c, value=-1)
    inflation = 2 * product / determinant.clamp_min(0)
    d = determinant.sqrt_()
    trace = a + b
    scale = d * torch.add(trace, d, alpha=2).sqrt_()
    root = torch.stack([b + d, -c, -c, a + d], -1).div_(scale.unsqueeze(-1))
    return root.view(g.shape), inflation


def polar_by_svd(matrices: Tensor) -> Tensor:
    """U V^T of each matrix [batch, m, n], computed in float64; nan where a matrix is not finite.

    All min(m, n) singular values of the result are 1: where a matrix lacks rank, LAPACK's U and V complete it with an
    orthonormal basis of the null directions, which depends on nothing but the matrix.
    """
    finite = matrices.isfinite().flatten(1).all(1)[:, None, None]
    u, _, vh = torch.linalg.svd(matrices.double().masked_fill(~finite, 0), full_matrices=False)
    factor: Tensor = u @ vh
    return factor.to(matrices.dtype).masked_fill_(~finite, torch.nan)
