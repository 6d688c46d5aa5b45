"""A run's returns at a glance: a few values of the running mean, evenly spaced over all its episodes."""

from __future__ import annotations

from typing import Any

from coop.common.bounds import MAX_POINTS


class ReturnHistory:
    """Keeps the running mean at every n-th episode; n doubles whenever there are `MAX_POINTS` values.

    values: the running means, the oldest first.
    """

    def __init__(self) -> None:
        self.values: list[float] = []
        self._every = 1

    def add(self, episodes: int, mean: float) -> None:
        """Note the running mean after the given number of episodes; called after each episode."""
        if episodes % self._every:
            return
        if len(self.values) == MAX_POINTS:
            self._every *= 2
            self.values = self.values[1::2]
            if episodes % self._every:
                return
        self.values.append(mean)

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {"values": list(self.values), "every": self._every}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
        self.values, self._every = list(state["values"]), state["every"]
