"""How many threads the arithmetic of a process has."""

from __future__ import annotations

import sys

from threadpoolctl import threadpool_limits


def use_threads(count: int) -> None:
    """Limit numpy's BLAS and, if it has been imported, PyTorch to `count` threads; by default both use every core."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(count)
    threadpool_limits(count, user_api="blas")
