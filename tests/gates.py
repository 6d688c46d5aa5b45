"""Gates: a walk in whose every state two of four actions are allowed, and any other one is an error."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

STATES, ACTIONS = 6, 4


def mask_of(observations: Any) -> NDArray[np.bool_]:
    """The masks, bool [..., 4], of observations, float32 [..., 6]: state k allows actions k and k + 1, modulo 4."""
    state = np.asarray(observations).argmax(-1)[..., None]
    return (np.arange(ACTIONS) == state % ACTIONS) | (np.arange(ACTIONS) == (state + 1) % ACTIONS)


class Gates(gymnasium.Env[Any, Any]):
    """Begins in a random one of the first three states; every step leads to the next, and the last one ends it.

    Action k gives reward 0 in state k, and k + 1 gives 1. dtype: of the masks. wrong: what is wrong with them from step
    2 on. terminal: whether the last state's mask allows anything.
    """

    def __init__(self, dtype: str = "int8", wrong: str = "", terminal: bool = False) -> None:
        self.observation_space = Box(0.0, 1.0, (STATES,), np.float32)
        self.action_space = Discrete(ACTIONS)
        self._dtype, self._wrong, self._terminal, self._state, self._steps = dtype, wrong, terminal, 0, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin."""
        super().reset(seed=seed)
        self._state = int(self.np_random.integers(3))
        return self._seen(), self.info()

    def step(self, action: Any) -> Any:
        """Take an action that is allowed."""
        if not mask_of(self._seen())[action]:
            raise ValueError(f"action {action} in state {self._state}")
        reward = float(action == (self._state + 1) % ACTIONS)
        self._state, self._steps = self._state + 1, self._steps + 1
        return self._seen(), reward, self._state == STATES - 1, False, self.info()

    def _seen(self) -> Any:
        return np.eye(STATES, dtype=np.float32)[self._state]

    def _mask(self) -> Any:
        mask = mask_of(self._seen()).astype(self._dtype)
        if self._state == STATES - 1 and not self._terminal:
            mask[:] = 0
        if self._steps < 2:
            return mask
        wrong = {"shape": mask[:3], "dtype": mask.astype(np.float32), "values": mask * 2, "none": mask * 0, "no": None}
        return wrong.get(self._wrong, mask)

    def info(self) -> dict[str, Any]:
        """With the mask, as gymnasium's own environments give it."""
        mask = self._mask()
        return {} if mask is None else {"action_mask": mask}


class GatesByMethod(Gates):
    """As sb3-contrib has masks."""

    def info(self) -> dict[str, Any]:
        """Without masks."""
        return {}

    def action_masks(self) -> Any:
        """The mask of the present state."""
        if self._steps >= 2 and self._wrong == "raises":
            raise LookupError("no such gate")
        return self._mask()


gymnasium.register("Gates-v0", entry_point=Gates)
gymnasium.register("GatesByMethod-v0", entry_point=GatesByMethod)
