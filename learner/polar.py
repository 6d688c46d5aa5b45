"""Orthogonal polar factors of batches of small-sided matrices, robust against rank deficiency."""

from __future__ import annotations

import torch
from torch import Tensor


def polar(matrices: Tensor) -> Tensor:
    """U V^T of each matrix [..., m, n], with an arbitrary orthonormal completion of null directions."""
    u, _, vh = torch.linalg.svd(matrices, full_matrices=False)
    factor: Tensor = u @ vh
    return factor
