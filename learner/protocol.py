"""What the trainer and its records ask of an agent: one with a replay table, or one that learns from single steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch

from coop.common.networks.network import FlatNetwork
from coop.common.settings.config import RunConfig
from coop.common.transitions import Batch
from coop.common.types import Array, EnvSpec
from coop.learner.agent import Update
from coop.learner.losses import Loss, Values
from coop.learner.methods.rule import UpdateRule


class AnyAgent(Protocol):
    """See `coop.learner.agent.AnyAgent` for the attributes."""

    config: RunConfig
    spec: EnvSpec
    loss: Loss
    device: torch.device
    rule: UpdateRule
    lag: int

    @property
    def acting(self) -> int:
        """Index of the network that acts and is trained, 0 or 1."""

    @property
    def updates(self) -> int:
        """Number of updates done."""

    @property
    def networks(self) -> Sequence[FlatNetwork]:
        """The parameters of both networks."""

    @property
    def versions(self) -> Sequence[int]:
        """`updates` at each network's last change."""

    def update(self, batch: Batch) -> Update:
        """Learn from a batch."""

    def swap(self) -> None:
        """Change the acting role, or what the method does instead."""

    def epsilon(self, env_step: int) -> float:
        """Probability of a random action after `env_step` environment steps."""

    def feedback_scale(self) -> float:
        """The present scale of s."""

    def finite(self) -> bool:
        """True while every parameter is finite."""

    def q_values(self, obs: Array) -> tuple[Values, Values]:
        """Q1 and Q2, float32 [batch, actions], of stored observations <frame_dtype>[batch, *obs_shape]."""

    def own_td_errors(self, batch: Batch) -> Values | None:
        """The TD errors of a batch by a method's own targets, float32 [batch]; None if it has none of its own."""

    def state(self) -> dict[str, Any]:
        """The state for `load_state`."""

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
