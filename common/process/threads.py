"""How a process's arithmetic runs: its number of threads, and numbers next to 0."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


def use_threads(count: int) -> None:
    """Limit numpy's BLAS and, if it has been imported, PyTorch to `count` threads; by default both use every core."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(count)
    threadpool_limits(count, user_api="blas")


@contextmanager
def subnormals_as_zero() -> Iterator[None]:
    """Let PyTorch and numpy take numbers below 1.2e-38 as 0, in this thread and in those that it starts meanwhile.

    An optimizer's moments of a parameter without a gradient, of a ReLU that is off for every state, fall below that and
    are never rounded to 0, and processors take many times as long for products with such numbers.
    """
    import torch  # noqa: PLC0415 - the replay service runs without it

    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)
