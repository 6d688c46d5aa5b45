"""Numbers: updates due, the running mean of returns over the last 100 episodes, exact text, strict JSON."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

RETURN_WINDOW = 100  # episodes
METRICS_EVERY = 200  # updates from one row of metrics to the next


def updates_due(ratio: float, steps: int) -> int:
    """Updates due after so many steps of a replay ratio: the nearest whole number, of two the larger; at least 0."""
    return max(0, math.floor(ratio * steps + 0.5))


def exact(value: float) -> str:
    """The shortest text that reads as the same number, without a fraction of zero: "1234567.89", "9", "nan"."""
    return repr(float(value)).removesuffix(".0")


def running_mean(values: ArrayLike, window: int = RETURN_WINDOW) -> NDArray[np.float64]:
    """float64 [episodes]: the mean of each episode's value and up to `window` - 1 before it."""
    total = np.concatenate(([0.0], np.cumsum(np.asarray(values, np.float64))))
    ends = np.arange(1, len(total))
    starts = np.maximum(0, ends - window)
    return np.asarray((total[ends] - total[starts]) / (ends - starts))


def strict_json(value: Any, indent: int | None = None) -> str:  # noqa: ANN401 (plain values, tables and lists)
    """A value as JSON, in which numbers that are not finite, which JSON lacks, are null."""
    try:
        return json.dumps(value, indent=indent, allow_nan=False)
    except ValueError:
        return json.dumps(finite(value), indent=indent)


def finite(value: Any) -> Any:  # noqa: ANN401 (as `strict_json`)
    """Numbers that are not finite become None, in nested lists and tables."""
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {name: finite(each) for name, each in value.items()}
        case list() | tuple():
            return [finite(each) for each in value]
    return value
