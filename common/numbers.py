"""Numbers: whole ones in texts, updates due, means, exact text, strict JSON, speeds, states of random generators.

The running mean over the last 100 episodes is the paper's measure.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

RETURN_WINDOW = 100  # episodes
SHORT_WINDOW = 20  # episodes: few enough to show what play has just reached
METRICS_EVERY = 200  # updates from one row of metrics to the next


def whole_number(text: str) -> int:
    """Read a whole number: 1000000, 1_000_000 or 1e6."""
    try:
        return int(text)
    except ValueError:
        with suppress(ValueError):
            if (number := float(text)).is_integer():
                return int(number)
        raise


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


def generator_state(rng: np.random.Generator) -> dict[str, Any]:
    """The state of a Generator over PCG64, for `set_generator_state`.

    128-bit numbers become text, because msgpack's integers have 64 bits.
    """
    state = rng.bit_generator.state
    return {**state, "state": {name: str(number) for name, number in state["state"].items()}}


def set_generator_state(rng: np.random.Generator, state: Mapping[str, Any]) -> None:
    """Set `rng` to a state from `generator_state`."""
    rng.bit_generator.state = {**state, "state": {name: int(digits) for name, digits in state["state"].items()}}


class Rate:
    """The growth per second of a count over the last seconds.

    Args:
        window: seconds to look back.
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._points: deque[tuple[float, int]] = deque()

    def at(self, now: float, count: int) -> float:
        """Note the count; return its rate, 0 at the first call."""
        if self._points and now <= self._points[-1][0]:
            self._points.pop()
        self._points.append((now, count))
        while len(self._points) > 2 and self._points[1][0] <= now - self._window:
            self._points.popleft()
        then, before = self._points[0]
        return max(0.0, (count - before) / (now - then)) if now > then else 0.0
