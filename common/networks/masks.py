"""Action masks: which actions a state allows, for values and for chance."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor  # which actors of a small network do without

Values = TypeVar("Values", "Tensor", NDArray[Any])

LEAST = -1e18
"""Stands for the value of an action that is not allowed. Finite, and so are its square and its multiple of 1 / 0.001,
because a rule of a user's own may compute with it before it leaves the action out."""


def allowed(values: Values, mask: Values | None) -> Values:
    """Q-values [batch, actions], with `LEAST` for the actions that a mask, bool [batch, actions], does not allow.

    None allows all: the values are returned as they are.
    """
    if mask is None:
        return values
    if isinstance(values, np.ndarray):
        return np.where(mask, values, np.float32(LEAST))
    return values.masked_fill(~mask, LEAST)


def random_actions(
    rng: np.random.Generator, count: int, actions: int, mask: NDArray[np.bool_] | None
) -> NDArray[np.int32]:
    """Draw actions uniformly, int32 [count], each among those that its row of a mask, bool [count, actions], allows."""
    if mask is None:
        return rng.integers(actions, size=count, dtype=np.int32)
    chance = rng.random((count, actions))
    drawn: NDArray[np.int32] = np.where(mask, chance, -1.0).argmax(1).astype(np.int32)
    return drawn
