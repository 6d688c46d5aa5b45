"""Arithmetic that runs both on PyTorch tensors and on numpy arrays.

numpy is for small networks on the CPU, where calling PyTorch costs more than the computation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

Array = Any  # a torch.Tensor or a numpy array
Namespace = Any  # torch or numpy


def namespace(array: Array) -> Namespace:
    """The library of `array`, torch or numpy; use only functions that both have with the same name and meaning."""
    return torch if isinstance(array, torch.Tensor) else np


def convert_like(values: Array, array: Array) -> Array:
    """Convert `values`, of either library, to the library, dtype and device of `array`, without a needless copy."""
    if isinstance(values, torch.Tensor) and values.dtype == torch.bfloat16:  # numpy lacks bfloat16
        values = values.float()
    return namespace(array).asarray(values, dtype=array.dtype, device=array.device)


def widened(array: Array) -> Array:
    """A copy of `array` in float64."""
    return array.double() if isinstance(array, torch.Tensor) else array.astype(np.float64)


def assign(array: Array, values: Array) -> None:
    """Overwrite `array` with `values`, of either library and any dtype, in one pass."""
    array[:] = values if namespace(values) is namespace(array) else convert_like(values, array)
