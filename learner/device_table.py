"""A replay table on the networks' device: the last steps of several emulators, drawn from within a recorded update."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from coop.common.types import EnvSpec
from coop.learner.edl import kernels
from coop.learner.given import Given
from coop.learner.losses import BatchColumns


class DeviceTable:
    """The last `capacity` steps of emulators that step together, first in, first out.

    Row t of an emulator has the observation that it showed, the action that was chosen there, and what led there: the
    reward, and whether the episode ended with it. An emulator that shows the end of an episode begins the next one in
    its next step, whatever the action; what begins at an end is no transition, and counts for nothing if it is drawn.

    Args:
        streams: number of emulators. n_step: rewards that a transition sums.

    Attributes:
        steps: rows so far, int64 [] on the device.
    """

    def __init__(
        self, spec: EnvSpec, capacity: int, streams: int, n_step: int, gamma: float, device: torch.device
    ) -> None:
        self._rows, self._streams, self._n, self._gamma = capacity // streams, streams, n_step, gamma
        if self._rows <= n_step:
            raise ValueError(
                f"capacity {capacity}: holds {self._rows} steps of each emulator; needs more than {n_step}"
            )
        shape = (self._rows, streams)
        self.steps = torch.zeros((), dtype=torch.int64, device=device)
        self._obs = torch.zeros(*shape, *spec.obs_shape, dtype=getattr(torch, spec.frame_dtype), device=device)
        self._actions = torch.zeros(shape, dtype=torch.int64, device=device)
        self._rewards, self._ended, self._terminated = (torch.zeros(shape, device=device) for _ in range(3))
        self._stack = torch.arange(spec.stack, dtype=torch.int32, device=device)
        self._frames = self._obs.view(-1, *spec.frame_shape)
        self._powers = gamma ** torch.arange(n_step + 1, device=device)

    def show(self, obs: Tensor, rewards: Tensor, terminated: Tensor, truncated: Tensor) -> None:
        """Begin a row with what the emulators show: <frame_dtype>[streams, *obs_shape], float32 [streams] each."""
        row = (self.steps % self._rows)[None]
        ended = torch.maximum(terminated, truncated)
        parts = ((self._obs, obs), (self._rewards, rewards), (self._ended, ended), (self._terminated, terminated))
        for column, values in parts:
            column.index_copy_(0, row, values[None])

    def act(self, actions: Tensor) -> None:
        """End the row with the actions chosen, int64 [streams]."""
        self._actions.index_copy_(0, (self.steps % self._rows)[None], actions[None])
        self.steps += 1

    def sample(self, size: int, s: Any, rate: Any) -> Given:  # noqa: ANN401
        """Draw transitions uniformly, with replacement; s and rate: see `Given`."""
        chance = torch.rand(2, size, device=self._obs.device)
        outcomes = (self._ended, self._terminated, self._rewards, self._actions)
        drawn = kernels.draws(chance, self.steps, outcomes, self._powers, len(self._stack))
        *columns, index = self._drawn(chance) if drawn is None else drawn
        return Given(self._frames, index, BatchColumns(*columns), s, rate)

    def _drawn(self, chance: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """See `kernels.draws`."""
        rows, held = self._rows, self.steps.clamp(max=self._rows) - self._n
        # Ages from n + 1: the row after a transition's last reward must be there, and the oldest row still whole.
        age = (chance[0] * held).long() + self._n + 1
        stream = (chance[1] * self._streams).long()
        first = self.steps - age
        window = (first[:, None] + torch.arange(1, self._n + 1, device=chance.device)) % rows
        ended = self._ended[window, stream[:, None]]
        alive = torch.cumprod(1 - ended, 1)
        before = torch.cat((torch.ones_like(alive[:, :1]), alive[:, :-1]), 1)  # no end before this step
        rewards = (before * self._powers[:-1] * self._rewards[window, stream[:, None]]).sum(1)
        span = before.sum(1).long()
        last = (first + span) % rows
        discounts = self._powers[span] * (1 - self._terminated[last, stream])
        row = first % rows
        valid = 1 - self._ended[row, stream]
        places = torch.cat((row * self._streams + stream, last * self._streams + stream)).int()
        index = (places[:, None] * len(self._stack) + self._stack).view(-1)
        return self._actions[row, stream], rewards, discounts, valid, index
