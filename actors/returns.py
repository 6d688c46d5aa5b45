"""n-step returns, and the last step of each transition."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coop.common.types import Array


def n_step_returns(
    rewards: NDArray[np.float32], ends: NDArray[np.bool_], n: int, gamma: float
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Compute the transition that begins with each of these steps.

    A transition that begins at step t spans the steps t to t + n - 1, or fewer if an earlier one ends the episode.
    Its return is the sum of gamma^i r(t + i) over these steps.

    Args:
        rewards: float32 [steps, envs].
        ends: bool [steps, envs], the step is the last of its episode, terminated or truncated.

    Returns:
        last: int [steps, envs], the last step that each transition spans; it never decreases. A transition with `last`
            beyond these steps is not complete, and its return has no meaning yet.
        returns: float32 [steps, envs].
    """
    steps = np.arange(len(rewards))[:, None]
    if n == 1:
        return steps.repeat(rewards.shape[1], axis=1), rewards
    following = np.where(ends, steps, len(rewards) + n)[::-1]  # the step that ends the episode, if there is one
    last = np.minimum(steps + n - 1, np.minimum.accumulate(following)[::-1])
    returns: Array = rewards.astype(np.float64)
    for i in range(1, min(n, len(rewards))):
        returns[:-i] += gamma**i * np.where(last[:-i] >= steps[i:], rewards[i:], 0)
    return last, returns.astype(np.float32)
