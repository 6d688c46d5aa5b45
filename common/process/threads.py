"""The number of threads for a process's arithmetic."""

from __future__ import annotations

import torch
from threadpoolctl import threadpool_limits


def use_threads(count: int) -> None:
    """Limit PyTorch and numpy's BLAS to `count` threads; by default both use every core."""
    torch.set_num_threads(count)
    threadpool_limits(count, user_api="blas")
