"""Arithmetic that runs both on PyTorch tensors and on numpy arrays.

numpy is for small networks on the CPU, where calling PyTorch costs more than the computation. Code for both is generic
in `ArrayT`: it is checked once with tensors and once with numpy arrays, and never mixes them.
"""

# ruff: noqa: D102 - both libraries document these functions
from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

ArrayT = TypeVar("ArrayT", Tensor, NDArray[Any])
AnyArray = Tensor | NDArray[Any]


class Linalg(Protocol[ArrayT]):
    """The linear algebra that both libraries have with the same name and meaning."""

    def eigh(self, matrices: ArrayT, /) -> tuple[ArrayT, ArrayT]:
        """Eigenvalues [..., m], ascending, and eigenvectors [..., m, m] of symmetric matrices."""


class Namespace(Protocol[ArrayT]):
    """The functions that both libraries have with the same name and meaning, as far as they are used."""

    @property
    def linalg(self) -> Linalg[ArrayT]: ...
    def asarray(self, values: Any, *, dtype: Any, device: Any) -> ArrayT: ...  # noqa: ANN401
    def empty(self, shape: Sequence[int], *, dtype: Any, device: Any) -> ArrayT: ...  # noqa: ANN401
    def zeros_like(self, array: ArrayT, /) -> ArrayT: ...
    def broadcast_to(self, array: ArrayT, shape: Sequence[int], /) -> ArrayT: ...
    def where(self, condition: ArrayT, array: ArrayT, other: ArrayT | float, /) -> ArrayT: ...
    def isfinite(self, array: ArrayT, /) -> ArrayT: ...
    def amin(self, array: ArrayT, axis: int, /) -> ArrayT: ...
    def amax(self, array: ArrayT, axis: int, /) -> ArrayT: ...
    def einsum(self, subscripts: str, /, *arrays: ArrayT) -> ArrayT: ...
    def clip(self, array: ArrayT, low: float | None, high: float | None, /, *, out: ArrayT | None = None) -> ArrayT: ...
    def add(self, array: ArrayT, other: ArrayT | float, /, *, out: ArrayT) -> ArrayT: ...
    def subtract(self, array: ArrayT, other: ArrayT, /, *, out: ArrayT) -> ArrayT: ...
    def multiply(self, array: ArrayT, other: ArrayT | float, /, *, out: ArrayT) -> ArrayT: ...
    def divide(self, array: ArrayT, other: ArrayT, /, *, out: ArrayT) -> ArrayT: ...
    def sqrt(self, array: ArrayT, /, *, out: ArrayT) -> ArrayT: ...


def namespace(array: ArrayT) -> Namespace[ArrayT]:
    """The library of `array`, torch or numpy."""
    return cast("Namespace[ArrayT]", torch if isinstance(array, Tensor) else np)


def convert_like(values: AnyArray, array: ArrayT) -> ArrayT:
    """Convert `values`, of either library, to the library, dtype and device of `array`, without a needless copy."""
    if isinstance(values, Tensor) and values.dtype == torch.bfloat16 and not isinstance(array, Tensor):
        values = values.float()  # numpy lacks bfloat16
    return namespace(array).asarray(values, dtype=array.dtype, device=array.device)


def widened(array: ArrayT) -> ArrayT:
    """A copy of `array` in float64."""
    return array.double() if isinstance(array, Tensor) else array.astype(np.float64)


def in_dtype(array: ArrayT, dtype: torch.dtype | None) -> ArrayT:
    """A tensor in `dtype`, without a needless copy; the array itself if it is numpy's or dtype is None."""
    return array.to(dtype) if isinstance(array, Tensor) and dtype is not None else array


def at_least_float32(array: ArrayT) -> ArrayT:
    """`array` in float32 if it is in bfloat16, without a needless copy."""
    return array.float() if isinstance(array, Tensor) and array.dtype == torch.bfloat16 else array


def assign(array: ArrayT, values: AnyArray) -> None:
    """Overwrite `array` with `values`, of either library and any dtype, in one pass."""
    array[:] = values if type(values) is type(array) else convert_like(values, array)


def chosen(values: ArrayT, actions: ArrayT) -> ArrayT:
    """values[i, actions[i]] of each row i: values [batch, actions], actions int64 [batch] -> [batch]."""
    if isinstance(values, Tensor):
        return values.gather(1, actions[:, None])[:, 0]
    picked: ArrayT = values[np.arange(len(actions)), actions]
    return picked


def placed(values: ArrayT, actions: ArrayT, like: ArrayT) -> ArrayT:
    """`values` [batch] at the columns `actions`, int64 [batch], of zeros shaped like `like` [batch, n]."""
    zeros = namespace(like).zeros_like(like)
    if isinstance(zeros, Tensor):
        return zeros.scatter_(1, actions[:, None], values[:, None])
    zeros[np.arange(len(actions)), actions] = values
    return zeros
