"""Orthogonal polar factors U V^T of matrices U S V^T, without an SVD if that is accurate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from coop.learner.edl.arrays import ArrayT, convert_like, namespace, widened

_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]  # the two other indices of three
_NUDGE = 1e-13  # of the largest entry of a matrix whose SVD fails
_SMALL = 16  # the shorter side up to which an SVD is faster than the algebra with a Gram matrix
_BLOCKED = 1 << 15  # entries from which on products of blocks are faster than LAPACK's reflections one by one


@dataclass(frozen=True, slots=True)
class _Limits:
    """Bounds within which the Gram matrix gives an accurate result.

    square: the shortest row's squared length. inflation: the largest sum of variance inflation factors (see
    `whitened`). ratio: the smallest ratio of two rows' squared lengths, of two eigenvalues for more than three rows.
    """

    square: float
    inflation: float
    ratio: float


LIMITS = {4: _Limits(1e-31, 3e2, 1e-11), 8: _Limits(1e-292, 1e6, 1e-9)}  # by bytes per number


def whitened(gram: ArrayT, e: ArrayT) -> tuple[ArrayT, ArrayT | None]:
    """G^(-1/2) e [..., m], and a mask bool [...] of inaccurate results, which are set to 0 (None if there are none).

    gram: float32 or float64 [..., m, m], Gram matrices of matrices in that dtype. e: [..., m], broadcast. For m > 2
    the algebra uses float64; the rounding of gram's entries, eps |t_i| |t_j|, limits the accuracy. With C the
    matrix G scaled to a unit diagonal, the polar factor's relative error is about
    eps |C^(-1)| <= eps sum_i (C^(-1))_ii: rows of very different length do no harm, nearly parallel rows do.
    These sums are the variance inflation factors of statistics.
    """
    limits = LIMITS[gram.itemsize]
    if gram.shape[-1] == 2:
        white, doubtful = _whitened_pairs(gram, e, limits)
    else:
        whiten = _whitened_triples if gram.shape[-1] == 3 else _whitened_by_eigh
        wide, doubtful = whiten(widened(gram), widened(e), limits)
        white = convert_like(wide, gram)
    if doubtful is not None:
        white[namespace(gram).broadcast_to(doubtful, white.shape[:-1])] = 0
    return white, doubtful


def _whitened_pairs(g: ArrayT, e: ArrayT, limits: _Limits) -> tuple[ArrayT, ArrayT | None]:
    """The closed form for 2 x 2: G^(-1/2) = ((t + d) I - G) / (d sqrt(t + 2 d)) with d^2 = det G and t = tr G.

    Computed in g's own dtype: rounding affects the determinant no more than the limit on inflation allows.
    """
    a, b, c = g[..., 0, 0], g[..., 1, 1], g[..., 0, 1]
    first, second = e[..., 0], e[..., 1]
    product, trace = a * b, a + b
    determinant = product - c * c
    # Both variance inflation factors are product / determinant; determinant / trace is below the shorter row's square.
    margin = determinant - (2 / limits.inflation) * product - limits.square * trace
    doubtful = None if float(margin.min()) > 0 else ~(margin > 0)
    d = determinant**0.5
    scale = d * (trace + 2 * d) ** 0.5
    # (inverse root of G)
    top: ArrayT = ((b + d) * first - c * second) / scale
    white = namespace(g).empty((*top.shape, 2), dtype=top.dtype, device=top.device)
    white[..., 0] = top
    white[..., 1] = ((a + d) * second - c * first) / scale
    return white, doubtful


def _whitened_triples(g: ArrayT, e: ArrayT, limits: _Limits) -> tuple[ArrayT, ArrayT | None]:
    """The closed form for 3 x 3, with the adjugate A of G and the invariants of U = G^(1/2).

    x = tr U, y = (x^2 - tr G) / 2 and z = det U solve x^2 = tr G + 2 y and y^2 = tr A + 2 x z, sums of positive terms
    only. Then U^(-1) = (y I + ((tr A + x z) A - A^2) / z^2) / (x y - z). In float64 this is as accurate as `eigh`.
    """
    xp = namespace(g)
    g = xp.einsum("...ij->ij...", g)
    first, second = g[_NEXT], g[_AFTER]
    a = first[:, _NEXT] * second[:, _AFTER] - first[:, _AFTER] * second[:, _NEXT]
    lengths, minors = xp.einsum("ii...->i...", g), xp.einsum("ii...->i...", a)
    determinant = (g[0] * a[0]).sum(0)
    shortest = xp.amin(lengths, 0)
    safe = (shortest > limits.square) & (shortest > limits.ratio * xp.amax(lengths, 0))
    safe &= (lengths * minors).sum(0) < limits.inflation * determinant
    # Implied by the line above, but for rounding: of a matrix of rank 1, minors and determinant are nothing else.
    safe &= determinant * limits.inflation**2 > lengths.prod(0)
    trace, minor, z = lengths.sum(0), minors.sum(0), determinant**0.5
    y = (minor + 2 * z * (3 * trace) ** 0.5) ** 0.5  # at most a tenth too large
    for _ in range(3):  # Newton's method doubles the digits
        x = (trace + 2 * y) ** 0.5
        next_y = (minor + 2 * x * z) ** 0.5
        y = y - (y - next_y) / (1 - z / (x * next_y))
    x = (trace + 2 * y) ** 0.5
    solved = xp.einsum("ij...,...j->...i", a / determinant, e)
    rest = (minor + x * z)[..., None] * solved - xp.einsum("ij...,...j->...i", a, solved)
    return (y[..., None] * e + rest) / (x * y - z)[..., None], None if safe.all() else ~safe


def _whitened_by_eigh(g: ArrayT, e: ArrayT, limits: _Limits) -> tuple[ArrayT, ArrayT | None]:
    xp = namespace(g)
    diagonal = xp.einsum("...ii->...i", g)
    safe = xp.isfinite(g).all((-2, -1)) & (xp.amin(diagonal, -1) > limits.square)
    values, vectors = xp.linalg.eigh(g if safe.all() else xp.where(safe[..., None, None], g, 0))
    safe &= values[..., 0] > limits.ratio * values[..., -1]
    inverse = 1 / xp.clip(values, limits.square, None)
    inflation = xp.einsum("...i,...ij,...j->...", diagonal, vectors * vectors, inverse)
    safe &= inflation <= limits.inflation
    rotated = xp.einsum("...ij,...i->...j", vectors, e)
    white = xp.einsum("...ij,...j->...i", vectors, inverse**0.5 * rotated)
    return white, None if safe.all() else ~safe


def inverse_root(grams: Tensor) -> Tensor:
    """G^(-1/2) of symmetric positive matrices, float64 [..., m, m]; nan if a matrix is not finite.

    On a processor LAPACK takes a tenth of the time of the products; on a GPU it would wait for the host.
    """
    if grams.is_cuda:
        return newton_schulz(grams)
    units = torch.eye(grams.shape[-1], dtype=grams.dtype)
    finite = grams.isfinite().all(-1).all(-1)[..., None, None]
    values, vectors = torch.linalg.eigh(torch.where(finite, grams, units))
    root: Tensor = (vectors * values.clamp_min(1e-300).rsqrt()[..., None, :]) @ vectors.mT
    return root.masked_fill(~finite, torch.nan)


def newton_schulz(grams: Tensor) -> Tensor:
    """G^(-1/2) of symmetric positive matrices, float64 [..., m, m], whose eigenvalues are above 1e-10 of their sum.

    The coupled Newton-Schulz iteration y <- y t, z <- t z with t = rho (3 I - rho^2 z y) / 2, from y = G / tr G and
    z = I, scaled (Chen and Chow 2014): with x the root of the smallest eigenvalue of z y, rho is what brings it closest
    to 1, but no more than is stable. x is known of the worst case, so rho is the same for all matrices.
    """
    units = torch.eye(grams.shape[-1], dtype=grams.dtype, device=grams.device)
    trace = grams.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    y, z = grams / trace, units
    for rho in SCALES:
        t = 1.5 * rho * units - 0.5 * rho**3 * (z @ y)
        y, z = y @ t, t @ z
    return z * trace.rsqrt()


def _scales() -> list[float]:
    x, scales = 1e-5, []
    while 1 - x > 1e-9:
        scales.append(min((3 / (1 + x + x * x)) ** 0.5, 1.6977))
        x = 0.5 * scales[-1] * x * (3 - scales[-1] ** 2 * x * x)
    return [*scales, 1.0]


SCALES = _scales()


def polar(matrix: Tensor, rng: np.random.Generator) -> Tensor:
    """U V^T of one matrix [m, n], by the Gram matrix of its shorter side, computed in float64; nan if not finite.

    rng: draws the completion of a rank-deficient matrix, see `polar_of_product`.
    """
    if matrix.shape[0] > matrix.shape[1]:
        return polar(matrix.t(), rng).t()
    wide = matrix.double()
    if len(wide) > _SMALL:
        units = torch.eye(len(wide), dtype=wide.dtype, device=wide.device)
        root, doubtful = whitened((wide @ wide.t()).unsqueeze(0), units)
        if doubtful is None:
            quick: Tensor = (root @ wide).to(matrix.dtype)
            return quick
    if not wide.isfinite().all():
        return torch.full_like(matrix, torch.nan)
    u, values, vh = svd(wide)
    if missing := len(wide) - (rank := _rank(values, matrix.dtype)):
        # Normal draws, projected off the row space, are uniform over the directions of its complement.
        draw = torch.from_numpy(rng.standard_normal((wide.shape[1], missing))).to(wide.device)
        for _ in range(2):  # the second pass removes the rounding errors of the first
            draw -= vh[:rank].t() @ (vh[:rank] @ draw)
        q, r = torch.linalg.qr(draw)
        vh = torch.cat((vh[:rank], (q * r.diagonal().sign()).t()))
    factor: Tensor = (u @ vh).to(matrix.dtype)
    return factor


def polar_of_product(left: Tensor, right: Tensor, rng: np.random.Generator) -> Tensor:
    """U V^T [m, n] of left^T right, whose rank is at most r < m, n: left [r, m], right [r, n]; nan if not finite.

    With the full QR factorisations left^T = Q R and right^T = P L, and the SVD R L^T = u s v, left^T right is
    Q u s v P^T. So U V^T is Q u K v P^T, where K is the identity for the singular values above the rounding of the
    dtype, and pairs the null directions, where u and v are extended by an identity.

    The pairing is a signed permutation drawn from rng, which has the mean (0) and the covariance of an orthogonal
    matrix drawn uniformly. A fixed pairing would push the weights the same way in every update.
    """
    if left.shape[1] > right.shape[1]:
        return polar_of_product(right, left, rng).t()
    r, m, n, dtype = len(left), left.shape[1], right.shape[1], left.dtype
    (q, q_tau), (p, p_tau) = torch.geqrf(left.t().double()), torch.geqrf(right.t().double())
    corner = q[:r].triu() @ p[:r].triu().t()
    if not corner.sum().isfinite():
        return torch.full((m, n), torch.nan, dtype=dtype, device=left.device)
    u, values, vh = svd(corner)
    places, signs = _pairing(m, n, _rank(values, dtype), rng)
    places, signs = places.to(corner.device), signs.to(corner.device, dtype)[:, None]
    u, vh, q, q_tau, p, p_tau = (each.to(dtype) for each in (u, vh, q, q_tau, p, p_tau))
    factor = torch.zeros((m, n), dtype=dtype, device=left.device).scatter_(1, places[:, None], signs)
    factor[:r] = u @ factor[:r]
    factor[:, :r] = factor[:, :r] @ vh
    if m * n < _BLOCKED:
        factor = torch.ormqr(q, q_tau, factor)
        return torch.ormqr(p, p_tau, factor, left=False, transpose=True)
    # With Q = I - y t y^T and P = I - z w z^T, and K, u and v as above: K has one entry in each row.
    (y, t), (z, w) = _reflector(q, q_tau), _reflector(p, p_tau)
    turned, paired = torch.cat((u.t() @ y[:r], y[r:])), torch.cat((vh @ z[:r], z[r:]))
    paired = (paired[places] * signs) @ w.t()  # K v z w^T
    first = y @ t
    second = torch.cat((u @ paired[:r], paired[r:])) - first @ (turned.t() @ paired)
    rows = torch.zeros((r, n), dtype=dtype, device=left.device)
    rows[:, places] = (turned * signs).t()
    rows[:, :r] = rows[:, :r] @ vh  # y^T u K v
    return factor.addmm_(torch.cat((first, second), 1), torch.cat((rows, z.t())), alpha=-1)


def _reflector(qr: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
    """Y [m, r] and T [r, r] of Q = I - Y T Y^T, from LAPACK's form of a QR factorisation [m, r]."""
    r = len(tau)
    y = torch.cat((qr[:r].tril(-1) + torch.eye(r, dtype=qr.dtype, device=qr.device), qr[r:]))
    links = tau[:, None] * (y.t() @ y)  # above the diagonal
    return y, torch.linalg.solve_triangular(links, tau.diag(), upper=True, unitriangular=True)


def _rank(values: Tensor, dtype: torch.dtype) -> int:
    """The number of singular values (in descending order) above the rounding of a matrix in `dtype`."""
    return int((values > torch.finfo(dtype).eps * values[0]).sum())


def _pairing(m: int, n: int, rank: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """The column of each of m <= n rows, and its sign: an identity [rank, rank], beside it a random choice."""
    columns, signs = np.arange(m), np.ones(m)
    columns[rank:] = rank + rng.permutation(n - rank)[: m - rank]
    signs[rank:] -= 2 * rng.integers(0, 2, m - rank)
    return torch.from_numpy(columns), torch.from_numpy(signs)


def svd(matrices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """U, S and V^T, without null spaces, of finite matrices, float64 [..., m, n].

    LAPACK's divide and conquer fails to converge on rare matrices. Such a one is decomposed with its last digits
    changed, far below the rounding of float32.
    """
    try:
        u, values, vh = torch.linalg.svd(matrices, full_matrices=False)
    except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
        if matrices.ndim > 2 and len(matrices) > 1:  # one failure fails the batch
            parts = zip(*(svd(matrix) for matrix in matrices), strict=True)
            u, values, vh = (torch.stack(part) for part in parts)
        else:
            noise = torch.randn(matrices.shape, generator=torch.Generator().manual_seed(0), dtype=matrices.dtype)
            nudged = matrices + _NUDGE * matrices.abs().amax() * noise.to(matrices.device)
            u, values, vh = torch.linalg.svd(nudged, full_matrices=False)
    return u, values, vh


def polar_by_svd(matrices: Tensor, rank: int | None = None) -> Tensor:
    """U V^T of each matrix [batch, m, n], computed in float64; nan if a matrix is not finite.

    rank: number of singular values to keep, the largest; min(m, n) if None. They are 1 in the result: LAPACK's U and V
    complete a matrix of a lower rank with an orthonormal basis of null directions, which depends only on the matrix.
    """
    m = matrices.double()
    broken = None if m.sum().isfinite() else ~m.isfinite().flatten(1).all(1)[:, None, None]
    u, _, vh = svd(m if broken is None else m.masked_fill(broken, 0))
    factor: Tensor = (u[..., :rank] @ vh[..., :rank, :]).to(matrices.dtype)
    return factor if broken is None else factor.masked_fill_(broken, torch.nan)
