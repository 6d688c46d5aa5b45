"""Arithmetic that is written once and runs on PyTorch tensors and on numpy arrays.

numpy is for small networks on the host, where a call of PyTorch costs more than what it computes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

Array = Any  # a torch.Tensor or a numpy array
Namespace = Any  # torch or numpy


def namespace(array: Array) -> Namespace:
    """The library of `array`: torch or numpy. Of it, only what both name and mean alike may be used."""
    return torch if isinstance(array, torch.Tensor) else np


def like(values: Array, array: Array) -> Array:
    """`values`, of either library, in the library, dtype and device of `array`; without a copy where that is so."""
    if isinstance(values, torch.Tensor) and values.dtype == torch.bfloat16:  # which numpy does not know
        values = values.float()
    return namespace(array).asarray(values, dtype=array.dtype, device=array.device)


def assign(array: Array, values: Array) -> None:
    """Overwrite `array` with `values`, of either library and any dtype, in one pass."""
    array[:] = values if namespace(values) is namespace(array) else like(values, array)
