"""What is measured over the updates of an interval, and the episodes' running return."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from common.messaging.experience import Drawn
from common.returns import RETURN_WINDOW
from common.types import Array, Batch
from learner.agent import Agent, UpdateResult

FIXED_STATES = 256


class Telemetry:
    """Collects from each update what one row of metrics.jsonl says of an interval.

    returns: of the last 100 episodes. fixed: the first states drawn, on which Q1 and Q2 are compared.
    """

    def __init__(self) -> None:
        self.returns: deque[float] = deque(maxlen=RETURN_WINDOW)
        self.episodes = 0
        self.fixed: Array | None = None
        self._errors: list[NDArray[np.float32]] = []
        self._batches: list[tuple[Array, Array, Array]] = []
        self._began = (time.monotonic(), 0, 0)

    def add(self, agent: Agent, batch: Batch, result: UpdateResult) -> None:
        """Note one update."""
        if self.fixed is None:
            stacks = batch.frames[batch.obs_index[:FIXED_STATES]]
            self.fixed = stacks.reshape(-1, *agent.spec.obs_shape)
        self._errors.append(result.td_errors)
        # Copies: the arrays may be views that would keep a whole message alive.
        self._batches.append((batch.age.copy(), batch.reuse.copy(), agent.updates - batch.param_version))

    def row(self, agent: Agent, drawn: Drawn, epsilon: float) -> dict[str, Any]:
        """The metrics of the updates since the last row."""
        errors = np.concatenate(self._errors) if self._errors else np.zeros(1, np.float32)
        age, reuse, lag = (
            np.concatenate([arrays[i] for arrays in self._batches]) if self._batches else np.zeros(1) for i in range(3)
        )
        now = time.monotonic()
        began, updates, steps = self._began
        seconds = max(now - began, 1e-9)
        self._errors, self._batches = [], []
        self._began = (now, agent.updates, drawn.inserted)
        assert self.fixed is not None
        q1, q2 = agent.q_values(self.fixed)
        return {
            "time": time.time(),
            "env_step": drawn.inserted,
            "update": agent.updates,
            "acting": agent.acting + 1,
            "td_error": float(np.abs(errors).mean()),
            "loss": float(agent.losses(errors).mean()),
            "s": agent.exploration_rate(),
            "epsilon": epsilon,
            "q_gap": float((q1 - q2).norm(dim=1).mean()),
            "q1_mean": float(q1.mean()),
            "q2_mean": float(q2.mean()),
            "updates_per_s": (agent.updates - updates) / seconds,
            "env_steps_per_s": (drawn.inserted - steps) / seconds,
            "replay_size": drawn.size,
            "sample_age_mean": float(age.mean()),
            "sample_age_p95": float(np.percentile(age, 95)),
            "reuse_mean": float(reuse.mean()),
            "evicted_unsampled": drawn.evicted_unsampled / max(1, drawn.evicted),
            "weight_lag_mean": float(lag.mean()),
        }

    def state(self) -> dict[str, Any]:
        """What `load_state` needs; loads with weights_only."""
        fixed = None if self.fixed is None else torch.from_numpy(self.fixed.copy())
        return {"returns": list(self.returns), "episodes": self.episodes, "fixed": fixed}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.returns.extend(state["returns"])
        self.episodes = state["episodes"]
        self.fixed = None if state["fixed"] is None else state["fixed"].numpy()

    def episode(self, episode_return: float) -> int:
        """Note a finished episode; its number, from 0."""
        self.returns.append(episode_return)
        self.episodes += 1
        return self.episodes - 1

    @property
    def return_mean(self) -> float:
        """Mean return of the last 100 episodes; 0 before the first."""
        return float(np.mean(self.returns)) if self.returns else 0.0

    @property
    def return_sd(self) -> float:
        """Standard deviation of the returns of the last 100 episodes."""
        return float(np.std(self.returns)) if self.returns else 0.0
