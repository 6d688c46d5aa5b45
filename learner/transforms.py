"""The transforms T(i) of one batch and their polar factors, which error-driven learning feeds back through."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import groupby

import torch
from torch import Tensor

from learner.backprop import Chain, Tape
from learner.polar import polar_by_svd, whitened

# Rows at least this long are combined by a batched product; below, its cost per matrix outweighs its speed.
_LONG_ROW = 2048


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
        self._linear_end = chain.output_weight is not None
        self._basis = _basis(chain.output_weight, output)
        self._layers: list[tuple[int, torch.Size]] = []
        ts: list[Tensor] = []
        start = self._basis.unsqueeze(0)
        for index, t in chain.walk(tape, start if dtype is None else start.to(dtype), dtype):
            self._layers.append((index, t.shape[2:]))
            if len(self._layers) > 1 or not self._linear_end:
                ts.append(_flat(t).to(output.dtype))
        # Neighbours of one shape are handled together: [layers, batch or 1, A, n], the last layer first.
        groups = [list(group) for _, group in groupby(ts, lambda t: t.shape)]
        self._groups = [torch.stack(group) if len(group) > 1 else group[0].unsqueeze(0) for group in groups]

    def pull(self, error: Tensor, plain: float, s: float) -> Iterator[tuple[int, Tensor]]:
        """(step, (plain T(i) + s U V^T)^T e) for each layer, the last first: error [batch, A] -> [batch, *shape]."""
        layers = iter(self._layers)
        if self._linear_end:
            yield next(layers)[0], error * (plain + s)
        e = error @ self._basis.mT
        white, unsafe = self._whitened(e.unsqueeze(-1))
        weights = white.squeeze(-1).mul_(s)
        if plain:
            weights.add_(e, alpha=plain)
        first = 0
        for ts in self._groups:
            sigmas = _combine(weights[first : first + len(ts)], ts)
            for sigma, t in zip(sigmas, ts, strict=True):
                if unsafe is not None:
                    samples, factor = self._repair(unsafe[first], t)
                    sigma[samples] += s * _combine(e[samples].unsqueeze(0), factor.unsqueeze(0))[0]
                index, shape = next(layers)
                yield index, _shaped(sigma, shape)
                first += 1

    def matrices(self, s: float) -> list[tuple[int, Tensor]]:
        """(step, B(i) = T(i) + s U V^T), the last first: [batch, A, n_i], images in the order of channels first."""
        found = []
        layers = iter(self._layers)
        identity = torch.eye(self._actions, dtype=self._basis.dtype, device=self._basis.device)
        if self._linear_end:
            found.append((next(layers)[0], (identity * (1 + s)).expand(self._batch, -1, -1)))
        roots, unsafe = self._whitened(identity)
        for i, t in enumerate(t for ts in self._groups for t in ts):
            b = t + s * (roots[i] @ t)
            if unsafe is not None:
                samples, factor = self._repair(unsafe[i], t)
                b[samples] += s * factor
            b = self._basis.mT @ b
            index, shape = next(layers)
            found.append((index, _shaped(b.flatten(0, 1), shape).reshape(b.shape)))
        return found

    def _whitened(self, e: Tensor) -> tuple[Tensor, Tensor | None]:
        """G(i)^(-1/2) e, [batch or 1, A, k], of each layer held, and where that is of no use.

        [layers, batch, A, k] and bool [layers, batch], or None.
        """
        shape = (-1, self._actions, self._actions)
        grams = [e.new_empty(0, self._batch, *shape[1:])]
        for ts in self._groups:
            rows = ts.flatten(0, 1)
            grams.append(torch.bmm(rows, rows.mT).view(len(ts), *shape).expand(-1, self._batch, -1, -1))
        return whitened(torch.cat(grams), e)

    def _repair(self, unsafe: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """The unsafe samples of a layer, and their polar factors: [k], [k, A, n_i]."""
        samples = unsafe.nonzero().squeeze(1)
        return samples, polar_by_svd(t.expand(self._batch, -1, -1)[samples])


def _combine(weights: Tensor, ts: Tensor) -> Tensor:
    """sum_a w_a t_a: weights [layers, batch, A], ts [layers, batch or 1, A, n] -> [layers, batch, n]."""
    if ts.shape[1] < weights.shape[1]:
        return weights @ ts.squeeze(1)
    if ts.shape[-1] < _LONG_ROW:
        return (weights.unsqueeze(-1) * ts).sum(-2)
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
    return t.permute(0, 1, 3, 4, 2).flatten(2) if t.dim() == 5 else t.flatten(2)


def _shaped(rows: Tensor, shape: torch.Size) -> Tensor:
    """[rows, n] of `_flat` back to [rows, *shape]."""
    if len(shape) == 3:
        channels, height, width = shape
        return rows.view(-1, height, width, channels).permute(0, 3, 1, 2)
    return rows.view(-1, *shape)
