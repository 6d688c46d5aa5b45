"""The transforms T(i) of one batch and their polar factors, which error-driven learning feeds back through."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import groupby

import torch
from torch import Tensor

from learner.backprop import Chain, Tape
from learner.polar import polar_by_svd, whitened


class Transforms:
    """T(i) = d y / d a(i) of every layer with parameters, for each sample of a batch, ready to be applied.

    All A cotangents of a sample go down the network as one batch. They start from the rows of an orthogonal matrix Q
    and not from the identity, so what is held is Q T(i), which has T(i)'s singular values and V. Actions' values have
    most of their gradient in common; Q parts that from the differences, and the Gram matrices stay accurate in the
    network's own dtype. T of a Linear layer at the end is the identity and is not held.
    """

    def __init__(self, chain: Chain, tape: Tape, dtype: torch.dtype | None = None) -> None:
        """dtype: what to compute the T(i) in, the network's if None; their algebra is done in float32 or better."""
        output = tape.output
        self._batch, self._actions = output.shape
        self._basis = _basis(chain.output_weight, output)
        walk = chain.walk(
            tape, self._basis.unsqueeze(0) if dtype is None else self._basis.unsqueeze(0).to(dtype), dtype
        )
        self._linear_end = next(walk)[0] if chain.output_weight is not None else None
        # The layers held, the last first: step, shape of its output, and T as [batch or 1, A, n].
        self._layers: list[tuple[int, torch.Size]] = []
        self._ts: list[Tensor] = []
        for index, t in walk:
            self._layers.append((index, t.shape[2:]))
            self._ts.append(_flat(t) if dtype is None else _flat(t).to(output.dtype))
        # Neighbours of one shape are handled together: [layers, batch or 1, A, n].
        groups = [list(group) for _, group in groupby(self._ts, Tensor.size)]
        self._groups = [torch.stack(group) if len(group) > 1 else group[0].unsqueeze(0) for group in groups]

    def pull(self, error: Tensor, s: float, polar_only: bool = False) -> Iterator[tuple[int, Tensor]]:
        """(step, B(i)^T e) for each layer, the last first: error [batch, A] -> [batch, *shape].

        polar_only: s (U V^T)^T e instead of (T(i) + s U V^T)^T e.
        """
        if self._linear_end is not None:
            yield self._linear_end, error * s if polar_only else torch.add(error, error, alpha=s)
        e = torch.mm(error, self._basis.t())
        layers = iter(zip(self._layers, self._ts, strict=True))
        for ts in self._groups:
            white, doubtful = whitened(self._gram(ts), e)
            sigmas = _combined(white * s if polar_only else torch.add(e, white, alpha=s), ts)
            for i, sigma in enumerate(sigmas.unbind(0)):
                (index, shape), t = next(layers)
                if doubtful is not None:
                    where = doubtful[i]
                    sigma[where] += s * (e[where].unsqueeze(-2) @ self._by_svd(t, where)).squeeze(-2)
                yield index, _shaped(sigma, shape)

    def matrices(self, s: float) -> list[tuple[int, Tensor]]:
        """(step, B(i) = T(i) + s U V^T), the last first: [batch, A, n_i], images in the order of channels first."""
        found = []
        units = torch.eye(self._actions, dtype=self._basis.dtype, device=self._basis.device)
        if self._linear_end is not None:
            found.append((self._linear_end, (units * (1 + s)).expand(self._batch, -1, -1)))
        for (index, shape), t in zip(self._layers, self._ts, strict=True):
            root, doubtful = whitened(self._gram(t.unsqueeze(0))[0].unsqueeze(1), units)
            b = t + s * (root @ t)
            if doubtful is not None:
                where = doubtful.squeeze(1)
                b[where] += s * self._by_svd(t, where)
            b = self._basis.mT @ b
            found.append((index, _shaped(b.flatten(0, 1), shape).reshape(b.shape)))
        return found

    def _gram(self, ts: Tensor) -> Tensor:
        """G(i) = T(i) T(i)^T of layers of one shape: [layers, batch, A, A]."""
        rows = ts.flatten(0, 1)
        gram = torch.bmm(rows, rows.mT).view(ts.shape[0], -1, self._actions, self._actions)
        return gram if gram.shape[1] == self._batch else gram.expand(-1, self._batch, -1, -1)

    def _by_svd(self, t: Tensor, where: Tensor) -> Tensor:
        """Polar factors of the samples of T [batch or 1, A, n] that are true in `where`: [k, A, n]."""
        return polar_by_svd(t.expand(self._batch, -1, -1)[where])


def _combined(weights: Tensor, ts: Tensor) -> Tensor:
    """sum_a w_a t_a: weights [layers, batch, A], ts [layers, batch or 1, A, n] -> [layers, batch, n]."""
    if weights.shape[-1] == 2:
        (v, w), (t, u) = weights.unsqueeze(-1).unbind(2), ts.unbind(2)
        return torch.addcmul(v * t, w, u)
    if ts.shape[1] < weights.shape[1]:
        return weights @ ts.squeeze(1)
    return (weights.unsqueeze(-2) @ ts).squeeze(-2)


def _basis(output_weight: Tensor | None, like: Tensor) -> Tensor:
    """An orthogonal Q [A, A] such that the rows of Q W, for the output weight W [A, n], are near orthogonal."""
    actions = like.shape[1]
    if actions == 2:
        return _sum_and_difference(like.dtype, like.device)
    if output_weight is None:
        return torch.eye(actions, dtype=like.dtype, device=like.device)
    w = output_weight.double()
    vectors: Tensor = torch.linalg.eigh((w @ w.mT).nan_to_num_()).eigenvectors
    return vectors.mT.to(like.dtype)


@cache
def _sum_and_difference(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor([[1.0, 1.0], [1.0, -1.0]], dtype=dtype, device=device).mul_(0.5**0.5)


def _flat(t: Tensor) -> Tensor:
    """[b, A, channels, height, width] with channels last in memory, as [b, A, n] without a copy."""
    return t.permute(0, 1, 3, 4, 2).flatten(2) if t.dim() == 5 else t


def _shaped(rows: Tensor, shape: torch.Size) -> Tensor:
    """[rows, n] of `_flat` back to [rows, *shape]."""
    if len(shape) == 1:
        return rows
    channels, height, width = shape
    return rows.view(-1, height, width, channels).permute(0, 3, 1, 2)
