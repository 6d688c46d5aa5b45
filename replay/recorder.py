"""The recorder of a replay core's changes, which a journal implements."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coop.common.transitions import DrawRequest
from coop.replay.limiter import RateLimiter


class Recorder(Protocol):
    """Records the changes of a core, in order, before the requests are answered."""

    def insert(self, payload: bytes, transitions: int) -> None:
        """Record an insert request that is about to be applied; transitions: how many it adds.

        Raises:
            OSError: it could not be recorded, and must not be applied.
        """

    def draw(self, request: DrawRequest, ids: NDArray[np.int64]) -> None:
        """Record a draw and the ids of its transitions, int64 [batch]; never fails, because the draw has happened."""

    def limit(self, limiter: RateLimiter) -> None:
        """Record new settings of the limiter; raises OSError as `insert`."""


class NullRecorder:
    """The recorder of a core without a journal."""

    def insert(self, payload: bytes, transitions: int) -> None:
        """See `Recorder`."""

    def draw(self, request: DrawRequest, ids: NDArray[np.int64]) -> None:
        """See `Recorder`."""

    def limit(self, limiter: RateLimiter) -> None:
        """See `Recorder`."""
