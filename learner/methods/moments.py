"""Running moments of a stream, one sample at a time, and what is scaled by them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

EPS = 1e-8  # added to variances

Moment = NDArray[np.float64]


class RunningMoments:
    """Mean and variance of all samples so far, by Welford's recurrences.

    count: samples so far. mean: float64 [*shape]. squares: float64 [*shape], the sum of squared deviations from it.
    """

    def __init__(self, shape: tuple[int, ...] = ()) -> None:
        self.count = 0
        self.mean: Moment = np.zeros(shape)
        self.squares: Moment = np.zeros(shape)

    def add(self, sample: NDArray[np.floating[Any]] | float) -> None:
        """Add a sample, <float>[*shape]."""
        self.count += 1
        before = sample - self.mean
        self.mean = self.mean + before / self.count
        self.squares = self.squares + before * (sample - self.mean)

    @property
    def sd(self) -> Moment:
        """Standard deviation, float64 [*shape]: the root of (sum of squared deviations) / (count - 1) + 1e-8.

        The variance of fewer than two samples counts as 1.
        """
        variance = self.squares / (self.count - 1) if self.count > 1 else np.ones_like(self.squares)
        return np.asarray(np.sqrt(variance + EPS))

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {"count": self.count, "mean": torch.tensor(self.mean), "squares": torch.tensor(self.squares)}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
        self.count, self.mean, self.squares = state["count"], state["mean"].numpy(), state["squares"].numpy()


class RewardScale:
    """Divides rewards by the standard deviation of u, the discounted sum of an episode's rewards.

    u <- gamma u (1 - ended) + r with each reward r.
    """

    def __init__(self, gamma: float) -> None:
        self._gamma = gamma
        self._sum = 0.0
        self._moments = RunningMoments()

    def __call__(self, reward: float, *, ended: bool) -> float:
        """Scale the reward of a step; ended: the episode ended with it."""
        self._sum = reward if ended else self._gamma * self._sum + reward
        self._moments.add(self._sum)
        return reward / float(self._moments.sd)

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {"sum": self._sum, **self._moments.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
        self._sum = state["sum"]
        self._moments.load_state(state)
