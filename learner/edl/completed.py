"""Polar factors of the Jacobians T(i) of a batch, as tensors: all samples at once, and no value decides on branches.

The polar factor of T [A, n] is P = G^(-1/2) T with G = T T^T. Where T lacks rank, or nearly so, G^(-1/2) would be
noise. There T is completed: P is that of T' = T + delta D R, where R [A, n] has a 1 in each row, in the first A
columns, and D [A, A] the lengths of T's rows. So P is a polar factor to about delta, in float32 to a hundredth, and
always has orthonormal rows. A mask picks the samples; G' = T' T'^T takes nothing but G and the first columns of T.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from coop.learner.edl import kernels
from coop.learner.edl.backprop import Subspace
from coop.learner.edl.polar import inverse_root

_EXACT = 2**18  # numbers in a layer's T up to which its Gram matrices are computed in float64
_ROUNDING = 1e-12  # of projections' entries, at most
_SHORT = 1e-3  # of the longest row: what a row's length counts as, at least


class Jacobians:
    """T(i) of several layers.

    ts: <float>[batch or 1, A, n] of each layer, contiguous. ranges: that of each T. basis: float64 [A, A], the
    orthogonal Q by which the rows have been multiplied. batch: number of samples.
    """

    def __init__(self, ts: Sequence[Tensor], ranges: Sequence[Subspace | None], basis: Tensor, batch: int) -> None:
        self._ts, self._basis, self._batch = ts, basis, batch
        # The kernels compute Gram matrices of their own.
        self._fused = kernels.fits(ts, batch) and all(reach is None for reach in ranges)
        self._ranges = ranges

    def apply(self, e: Tensor, s: Tensor | float) -> list[Tensor]:
        """(T + s P)^T e of each layer: e [batch, A] -> [batch, n]."""
        if self._fused:
            return kernels.feedback(self._ts, e, s)
        layers, roots, completions = self._solve(e[None, :, :, None].double())
        sigmas = []
        for i, layer in enumerate(layers):
            t = layer.t
            white, rest = roots[i, :, :, 0].to(t.dtype), completions[i, :, :, 0].to(e.dtype)
            weights = e + s * white
            sigma = (weights @ t[0] if len(t) < len(e) else torch.bmm(weights.unsqueeze(1), t).squeeze(1)).to(e.dtype)
            if layer.completable:
                sigma[:, : rest.shape[1]] += s * rest
            sigmas.append(sigma)
        return sigmas

    def matrices(self, s: float) -> list[Tensor]:
        """T + s P of each layer: [batch, A, n]."""
        units = torch.eye(len(self._basis), dtype=torch.float64, device=self._basis.device)
        layers, roots, completions = self._solve(units[None, None])
        found = []
        for i, (t, layer) in enumerate(zip(self._ts, layers, strict=True)):
            b = t + s * (roots[i].mT.to(layer.t.dtype) @ layer.t).to(t.dtype)
            if layer.completable:
                b[:, :, : completions.shape[2]] += s * completions[i].mT.to(t.dtype)
            found.append(b)
        return found

    def _solve(self, e: Tensor) -> tuple[list[_Layer], Tensor, Tensor]:
        """G'^(-1/2) e, and (delta D)^T times that: e float64 [1, batch or 1, A, k] -> [layers, batch, A, k] each."""
        shape = (self._batch, *self._basis.shape)
        layers = [_Layer(t, reach, self._basis) for t, reach in zip(self._ts, self._ranges, strict=True)]
        completed = [layer.completed() for layer in layers]
        grams, mixing = ([parts[i].expand(shape) for parts in completed] for i in (0, 1))
        white = inverse_root(torch.stack(grams)) @ e
        return layers, white, torch.stack(mixing).mT @ white


class _Layer:
    """T of one layer.

    completable: T can be completed to more rank. t: T, in float64 where it can't: what G^(-1/2) makes of the directions
    that T lacks is a million times as long, and only cancels there.
    """

    def __init__(self, t: Tensor, reach: Subspace | None, basis: Tensor) -> None:
        actions, width = t.shape[1:]
        exact = t.dtype == torch.float64 or t.numel() <= _EXACT
        # The rounding of G's entries, relative to the rows' lengths, is far below delta^2, the limit and the ridge.
        self._delta, self._limit, self._ridge = (1e-5, 1e-8, 1e-13) if exact else (1e-2, 1e-4, 1e-6)
        wide = t.double() if exact else t
        self._gram = torch.bmm(wide, wide.mT).double()
        self._inside: Tensor | None = None
        self.completable = reach is None and width >= actions
        if reach is not None:
            self.completable = reach.rank == reach.basis.shape[1] and width >= actions
            inside = basis @ reach.basis
            self._inside = inside @ inside.mT
            outside = _units(self._gram) - self._inside
            outside = outside * (outside.abs() > _ROUNDING)  # or the rows of a T of 0 would seem to be independent
            # The root of a sum of two matrices on orthogonal subspaces acts on T like that of G alone.
            self._gram = self._gram + _mean_square(self._gram) * outside
        self.t = t if self.completable else wide.double()

    def completed(self) -> tuple[Tensor, Tensor]:
        """G' of each sample, and delta D where T is completed, 0 elsewhere: float64 [batch or 1, A, A] each."""
        gram, delta = self._gram, self._delta
        if not self.completable:  # the thin factor, which leaves out what has no length
            size = _mean_square(gram)
            return gram + (self._ridge * size) * _units(gram), torch.zeros_like(gram)
        lengths = gram.diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
        longest = lengths.amax(1, keepdim=True)
        longest = longest + (longest == 0)
        if self._inside is None:
            mixing = torch.diag_embed(lengths + _SHORT * longest)
        else:
            mixing = longest[:, :, None] * self._inside
        # (independent rows)
        mixing = delta * mixing * ~independent(gram, self._limit)[:, None, None]
        crossed = self.t[:, :, : gram.shape[1]].double() @ mixing.mT
        return gram + crossed + crossed.mT + mixing @ mixing.mT, mixing


def independent(gram: Tensor, limit: float) -> Tensor:
    """Whether the rows behind each Gram matrix [..., m, m] are linearly independent: bool [...]; false for nan.

    In the order of the rows, each row's part that is orthogonal to those before it must have more than `limit` of its
    own squared length: these parts are the pivots of Gaussian elimination.
    """
    rest, sizes = gram, gram.diagonal(dim1=-2, dim2=-1)
    sound = sizes[..., 0] > 0
    for k in range(1, gram.shape[-1]):
        column = rest[..., 1:, :1]
        rest = rest[..., 1:, 1:] - column @ (column.mT / rest[..., :1, :1])
        sound = sound & (rest[..., 0, 0] > limit * sizes[..., k])
    return sound


def _mean_square(gram: Tensor) -> Tensor:
    """Of the rows' lengths, and 1 if all are 0: [batch, 1, 1]."""
    size = gram.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    return size + (size == 0)


def _units(gram: Tensor) -> Tensor:
    return torch.eye(gram.shape[1], dtype=gram.dtype, device=gram.device)
