"""How many threads the arithmetic of a process may use."""

from __future__ import annotations

import torch
from threadpoolctl import threadpool_limits


def use_threads(count: int) -> None:
    """Let PyTorch and numpy's BLAS use `count` threads, from now on; by default both take every core."""
    torch.set_num_threads(count)
    threadpool_limits(count, user_api="blas")
