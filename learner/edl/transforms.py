"""The transforms T(i) of one batch and their polar factors, through which error-driven learning feeds back."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, Generic

import numpy as np
import torch
from torch import Tensor

from coop.learner.edl.arrays import ArrayT, at_least_float32, convert_like, in_dtype, widened
from coop.learner.edl.backprop import Backprop, Tape
from coop.learner.edl.completed import Jacobians
from coop.learner.edl.polar import polar_by_svd

SUM_AND_DIFFERENCE = torch.tensor([[1.0, 1.0], [1.0, -1.0]], dtype=torch.float64) * 0.5**0.5


class Transforms(Generic[ArrayT]):
    """T(i) = d y / d a(i) of every layer with parameters, for each sample of a batch.

    All A cotangents of a sample pass through the network as one batch. They start from the rows of an orthogonal matrix
    Q instead of the identity, so this object holds Q T(i), which has T(i)'s singular values and V. The actions' values
    share most of their gradient; Q separates this part from the differences, which keeps the Gram matrices accurate in
    the network's own dtype. T of a final Linear layer is the identity and is not held.

    The polar factor of a T that lacks rank by construction (see `Subspace`) is the thin one, which stays in T's range.

    For arrays of numpy, samples without an accurate Gram matrix are found and get an SVD each. For tensors no value
    decides what is computed (see `coop.learner.edl.completed`).
    """

    _backprop: Backprop[ArrayT]
    _basis: ArrayT
    _dtype: Any
    _batch: int
    _actions: int
    _ts: list[ArrayT]

    def __init__(self, backprop: Backprop[ArrayT], tape: Tape[ArrayT]) -> None:
        """T(i) has the network's dtype; the algebra on them uses at least float32."""
        self._backprop = backprop
        self._batch, self._actions = tape.output.shape
        self._dtype = tape.output.dtype
        self._basis = _basis(backprop.output_weight, at_least_float32(tape.output))
        # (cotangents of all actions)
        walk = backprop.cotangents(tape, in_dtype(self._basis[None], self._dtype))
        self._linear_end = next(walk)[0] if backprop.output_weight is not None else None
        # The layers held, last first: step, shape of its output, and T as [batch or 1, A, n].
        self._layers: list[tuple[int, tuple[int, ...]]] = []
        self._ts = []
        for index, t in walk:
            self._layers.append((index, t.shape[2:]))
            flat = _flat(t)
            self._ts.append(flat if flat.dtype == self._basis.dtype else convert_like(flat, self._basis))
        self._ranges = [backprop.range_of(index) for index, _ in self._layers]

    def apply_feedback(self, error: ArrayT, s: Any) -> Iterator[tuple[int, ArrayT]]:  # noqa: ANN401
        """Yield (step, B(i)^T e) for each layer, last first: error [batch, A] -> [batch, *shape].

        s: a number, or a tensor of one where the arrays are tensors.
        """
        if self._linear_end is not None:
            # (last layer)
            yield self._linear_end, error * (1 + s)
        if not self._ts:
            return
        e = at_least_float32(error) @ self._basis.T
        if isinstance(e, Tensor):
            sigmas: list[Any] = list(self._jacobians().apply(e, s))
            for (index, shape), one in zip(self._layers, sigmas, strict=True):
                yield index, in_dtype(_shaped(one, shape), self._dtype)
            return
        backprop: Any = self._backprop
        grams: Any = np.concatenate([backprop.gram(t) for t in self._ts])
        white, doubtful = backprop.whitened(grams.reshape(-1, self._batch, self._actions, self._actions), e)
        # (weights of T)
        weights = e + s * white
        for i, (index, _) in enumerate(self._layers):
            # (sigma)
            sigma = backprop.combine(weights[i], self._ts[i])
            if doubtful is not None and doubtful[i].any():
                where = doubtful[i]
                # (by SVD)
                factors = convert_like(polar_by_svd(torch.as_tensor(self._ts[i][where])), e)
                sigma[where] += s * (e[where][:, None] @ factors)[:, 0]
            yield index, sigma

    def matrices(self, s: float) -> list[tuple[int, Tensor]]:
        """(step, B(i) = T(i) + s U V^T), last first: [batch, A, n_i], images with channels first; of tensors only."""
        found: list[tuple[int, Tensor]] = []
        basis: Any = self._basis
        if self._linear_end is not None:
            units = torch.eye(self._actions).to(basis)
            found.append((self._linear_end, (units * (1 + s)).expand(self._batch, -1, -1)))
        if self._ts:
            for (index, shape), whole in zip(self._layers, self._jacobians().matrices(s), strict=True):
                b = basis.mT @ whole
                found.append((index, _shaped(b, shape).reshape(b.shape)))
        return found

    def _jacobians(self) -> Jacobians:
        ts: Any = self._ts
        basis = _mean_first(self._actions, torch.float64, ts[0].device)
        return Jacobians(ts, self._ranges, basis, self._batch)


def _basis(output_weight: ArrayT | None, output: ArrayT) -> ArrayT:
    """An orthogonal Q [A, A] that makes the rows of Q W nearly orthogonal, for the output weight W [A, n].

    For few actions, without W, and for tensors, the first row of Q takes the mean of the actions' values: hardly less
    accurate, and the same for all weights.
    """
    actions = output.shape[1]
    if isinstance(output, Tensor):
        return _mean_first(actions, output.dtype, output.device)
    if actions == 2:
        return convert_like(SUM_AND_DIFFERENCE, output)
    if actions == 3 or output_weight is None:
        return convert_like(_reflection(actions), output)
    w: Any = widened(output_weight)
    gram = w @ w.T
    _, vectors = np.linalg.eigh(gram if np.isfinite(gram).all() else np.zeros_like(gram))
    return convert_like(vectors.T, output)


@cache
def _mean_first(actions: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Q [A, A] on its device, where it is copied once."""
    return (SUM_AND_DIFFERENCE if actions == 2 else _reflection(actions)).to(device, dtype)


@cache
def _reflection(size: int) -> Tensor:
    """float64 [size, size]: the Householder reflection that swaps the first axis and the diagonal of all axes."""
    normal = torch.full((size,), size**-0.5, dtype=torch.float64)
    normal[0] -= 1
    return torch.eye(size, dtype=torch.float64) - 2 * torch.outer(normal, normal) / normal.dot(normal).clamp_min(1e-300)


def _flat(t: ArrayT) -> ArrayT:
    """View [b, A, channels, height, width], channels last in memory, as [b, A, n]."""
    return t.permute(0, 1, 3, 4, 2).flatten(2) if isinstance(t, Tensor) and t.ndim == 5 else t


def _shaped(rows: ArrayT, shape: tuple[int, ...]) -> ArrayT:
    """Reverse `_flat`: [..., n] to [rows, *shape] if `shape` is a picture's."""
    if len(shape) == 1 or not isinstance(rows, Tensor):
        return rows
    channels, height, width = shape
    return rows.view(-1, height, width, channels).permute(0, 3, 1, 2)
