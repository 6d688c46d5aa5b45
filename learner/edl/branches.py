"""Parallel branches of a recorded update: kernels of small batches leave most of a GPU idle.

    with branching():                       # while a graph is recorded; elsewhere all is done at once, in order
        branches = Branches(array)
        values = branches.run(lambda: target(inputs), inputs)
        ...                                 # the current stream goes on
        branches.join()                     # and waits here

A branch begins behind all that the current stream has been given, so that memory which a stream has released, and takes
again, is no longer read by another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import cycle
from typing import Any, TypeVar

import torch
from torch import Tensor

Result = TypeVar("Result")

_LANES = 3  # streams beside the current one
_allowed = False


@contextmanager
def branching() -> Iterator[None]:
    """Let what is given to `Branches` run side by side."""
    global _allowed  # noqa: PLW0603 - one recording at a time in a process
    _allowed = True
    try:
        yield
    finally:
        _allowed = False


class Branches:
    """Work beside that of the current stream, until `join`."""

    def __init__(self, array: Any) -> None:  # noqa: ANN401
        """array: of the work; only tensors on a GPU have streams."""
        self._device = array.device if _allowed and isinstance(array, Tensor) and array.is_cuda else None
        self._lanes = None if self._device is None else cycle(_streams(self._device))
        self._used: set[torch.cuda.Stream] = set()
        self._read: list[Any] = []

    def run(self, work: Callable[[], Result], *read: Any) -> Result:  # noqa: ANN401
        """Do work that reads some arrays, which stay as they are until `join`; its result may be used after that."""
        if self._lanes is None:
            return work()
        lane = next(self._lanes)
        lane.wait_stream(torch.cuda.current_stream(self._device))
        self._used.add(lane)
        self._read += read
        with torch.cuda.stream(lane):
            return work()

    def join(self) -> None:
        """Let the current stream wait for all branches."""
        for lane in self._used:
            torch.cuda.current_stream(self._device).wait_stream(lane)
        self._used.clear()
        self._read.clear()


@cache
def _streams(device: torch.device) -> list[torch.cuda.Stream]:
    return [torch.cuda.Stream(device) for _ in range(_LANES)]  # type: ignore[no-untyped-call]
