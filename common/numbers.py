"""Returns: their running mean over the last 100 episodes, the paper's measure, and their exact text."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

RETURN_WINDOW = 100  # episodes
METRICS_EVERY = 200  # updates from one row of metrics to the next


def exact(value: float) -> str:
    """The shortest text that reads as the same number, without a fraction of zero: "1234567.89", "9", "nan"."""
    return repr(float(value)).removesuffix(".0")


def running_mean(values: ArrayLike, window: int = RETURN_WINDOW) -> NDArray[np.float64]:
    """float64 [episodes]: the mean of each episode's value and up to `window` - 1 before it."""
    total = np.concatenate(([0.0], np.cumsum(np.asarray(values, np.float64))))
    ends = np.arange(1, len(total))
    starts = np.maximum(0, ends - window)
    return np.asarray((total[ends] - total[starts]) / (ends - starts))
