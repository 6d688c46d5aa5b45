"""The transforms T(i) of one batch and their polar factors, which error-driven learning feeds back through."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from learner.backprop import Chain, Tape
from learner.polar import inverse_root, polar_by_svd


class Transforms:
    """T(i) = d y / d a(i) of every layer with parameters, for each sample of a batch, ready to be applied.

    All A cotangents of a sample go down the network as one batch. They start from the rows of an orthogonal matrix Q
    and not from the identity, so what is held is Q T(i), which has T(i)'s singular values and V.
    Actions' values have most of their gradient in common; Q parts that from the differences, and the
    Gram matrices stay accurate in the network's own dtype.
    """

    def __init__(self, chain: Chain, tape: Tape, dtype: torch.dtype | None = None) -> None:
        """dtype: what to compute the T(i) in, the network's if None; their algebra is done in float32 or better."""
        self._batch, actions = tape.output.shape
        self._basis = _basis(chain.output_weight, tape.output)
        self._layers: list[tuple[int, torch.Size]] = []
        self._ts: list[Tensor] = []
        compute = None if dtype == tape.output.dtype else dtype
        start = self._basis.unsqueeze(0).to(dtype, copy=True) if compute else self._basis.unsqueeze(0).clone()
        for index, t in chain.walk(tape, start, compute):
            self._layers.append((index, t.shape[2:]))
            self._ts.append(_flat(t).to(tape.output.dtype))
        grams = [(t @ t.mT).expand(self._batch, actions, actions) for t in self._ts]
        self._roots, self._safe = inverse_root(torch.stack(grams))
        self._all_safe = bool(self._safe.all())

    def pull(self, error: Tensor, plain: float, s: float) -> Iterator[tuple[int, Tensor]]:
        """(step, (plain T(i) + s U V^T)^T e) for each layer, the last first: error [batch, A] -> [batch, *shape]."""
        e = error @ self._basis.mT
        weights = (self._roots @ e.unsqueeze(-1)).squeeze(-1).mul_(s)
        if plain:
            weights.add_(e, alpha=plain)
        for i, (index, shape) in enumerate(self._layers):
            t, w = self._ts[i], weights[i]
            sigma = w @ t[0] if len(t) < self._batch else (w.unsqueeze(1) @ t).squeeze(1)
            if not self._all_safe:
                unsafe, factor = self._repair(i)
                sigma[unsafe] += s * (e[unsafe].unsqueeze(1) @ factor).squeeze(1)
            yield index, _shaped(sigma, shape)

    def matrices(self, s: float) -> list[tuple[int, Tensor]]:
        """(step, B(i) = T(i) + s U V^T), the last first: [batch, A, n_i], images in the order of channels first."""
        found = []
        for i, (index, shape) in enumerate(self._layers):
            t = self._ts[i].expand(self._batch, -1, -1)
            b = t + s * (self._roots[i] @ t)
            if not self._all_safe:
                unsafe, factor = self._repair(i)
                b[unsafe] += s * factor
            b = self._basis.mT @ b
            found.append((index, _shaped(b.flatten(0, 1), shape).reshape(b.shape)))
        return found

    def _repair(self, i: int) -> tuple[Tensor, Tensor]:
        """Samples of layer i whose Gram matrix is of no use, and their polar factors: [k], [k, A, n_i]."""
        unsafe = (~self._safe[i]).nonzero().squeeze(1)
        return unsafe, polar_by_svd(self._ts[i].expand(self._batch, -1, -1)[unsafe])


def _basis(output_weight: Tensor | None, like: Tensor) -> Tensor:
    """An orthogonal Q [A, A] such that the rows of Q W, for the output weight W [A, n], are near orthogonal."""
    actions = like.shape[1]
    if actions == 2:  # the sum and the difference
        return torch.tensor([[1.0, 1.0], [1.0, -1.0]], dtype=like.dtype, device=like.device).mul_(0.5**0.5)
    if output_weight is None:
        return torch.eye(actions, dtype=like.dtype, device=like.device)
    w = output_weight.double()
    gram = (w @ w.mT).nan_to_num_()
    vectors: Tensor = torch.linalg.eigh(gram).eigenvectors
    return vectors.mT.to(like.dtype)


def _flat(t: Tensor) -> Tensor:
    """[b, A, channels, height, width] with channels last in memory, as [b, A, n] without a copy."""
    return (t.permute(0, 1, 3, 4, 2) if t.dim() == 5 else t).flatten(2)


def _shaped(rows: Tensor, shape: torch.Size) -> Tensor:
    """[rows, n] of `_flat` back to [rows, *shape]."""
    if len(shape) == 3:
        channels, height, width = shape
        return rows.view(-1, height, width, channels).permute(0, 3, 1, 2)
    return rows.view(-1, *shape)
