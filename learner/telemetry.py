"""Metrics over the updates of an interval, and the running return of episodes; time is an argument."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop.common.bounds import MAX_POINTS
from coop.common.errors import UsageError
from coop.common.metrics import COLUMNS
from coop.common.numbers import RETURN_WINDOW
from coop.common.transitions import Batch, Drawn
from coop.common.types import Array
from coop.learner.diagnostics import Diagnostics
from coop.learner.losses import Values
from coop.learner.protocol import AnyAgent


class Telemetry:
    """Collects from each update the values for a row of metrics.jsonl.

    returns: of the last 100 episodes. history: their mean over the whole run. largest_reward: the largest |reward| of
    all batches. diagnostics: what is measured on the first 64 transitions drawn. q_abs_mean: mean |Q| of both networks
    over the states of those transitions at the last row. now: seconds of a monotonic clock.
    """

    def __init__(self, now: float) -> None:
        self.returns: deque[float] = deque(maxlen=RETURN_WINDOW)
        self.history = ReturnHistory()
        self.episodes = 0
        self.diagnostics = Diagnostics()
        self.largest_reward = 0.0
        self.q_abs_mean = 0.0
        self._errors: list[NDArray[np.float32]] = []
        self._batches: list[tuple[Array, ...]] = []
        self._began = (now, 0, 0)

    def add_errors(self, errors: Values) -> None:
        """Note the TD errors of one update, float32 [batch], before the next row."""
        self._errors.append(errors)

    def add(self, agent: AnyAgent, batch: Batch) -> None:
        """Note one update."""
        self.diagnostics.add(batch)
        self.largest_reward = max(self.largest_reward, float(np.abs(batch.rewards).max()))
        # Copies, because views would keep a whole message alive.
        lag = agent.updates - batch.param_version
        self._batches.append((batch.age.copy(), batch.reuse.copy(), lag, batch.terminated.copy(), batch.ids.copy()))

    def row(self, agent: AnyAgent, drawn: Drawn, epsilon: float, now: float) -> dict[str, Any]:
        """The metrics of the updates since the last row, of which there must be at least one."""
        errors = np.concatenate(self._errors)
        age, reuse, lag, terminal = (np.concatenate([arrays[i] for arrays in self._batches]) for i in range(4))
        distinct = sum(len(set(ids.tolist())) for *_, ids in self._batches)
        began, updates, steps = self._began
        seconds = max(now - began, 1e-9)
        self._errors, self._batches = [], []
        self._began = (now, agent.updates, drawn.inserted)
        measured = self.diagnostics.row(agent)
        self.q_abs_mean = measured["q_abs_mean"]
        return {
            "env_step": drawn.inserted,
            "update": agent.updates,
            "acting": agent.acting + 1,
            "td_error": float(np.abs(errors).mean()),
            "loss": float(agent.loss.cost(errors).mean()),
            "s": agent.feedback_scale(),
            "epsilon": epsilon,
            **measured,
            **self._bound(agent),
            "updates_per_s": (agent.updates - updates) / seconds,
            "env_steps_per_s": (drawn.inserted - steps) / seconds,
            "replay_size": drawn.size,
            "terminal_share": drawn.terminal / max(1, drawn.size),
            "terminal_drawn_share": float(terminal.mean()),
            "sample_age_mean": float(age.mean()),
            "sample_age_p95": float(np.percentile(age, 95)),
            "sample_age_histogram": powers_of_two(age),
            "reuse_mean": float(reuse.mean()),
            "reuse_histogram": powers_of_two(reuse)[1:],
            "distinct_share": distinct / len(reuse),
            "evicted_unsampled": drawn.evicted_unsampled / max(1, drawn.evicted),
            "weight_lag_mean": float(lag.mean()),
            **self._own(agent),
        }

    def _own(self, agent: AnyAgent) -> dict[str, float]:
        """The columns of the method's rule; raises UsageError for names of other columns."""
        own = {name: float(value) for name, value in agent.rule.metrics().items()}
        if taken := own.keys() & COLUMNS:
            raise UsageError(
                f"method = {agent.config.method!r}: its metrics can't be called {min(taken)!r}, as others are"
            )
        return own

    def q_bound(self, agent: AnyAgent) -> float | None:
        """The largest possible |Q|, (largest |reward| seen) / (1 - gamma); None if gamma is 1."""
        gamma = agent.config.learner.gamma
        return self.largest_reward / (1 - gamma) if gamma < 1 else None

    def _bound(self, agent: AnyAgent) -> dict[str, float]:
        bound = self.q_bound(agent)
        return {} if bound is None else {"q_bound": bound}

    def warning(self, agent: AnyAgent) -> str:
        """A warning that mean |Q| exceeds its bound; empty if it does not."""
        bound = self.q_bound(agent)
        if bound is None or self.q_abs_mean <= bound:
            return ""
        return f"mean |Q| is {self.q_abs_mean:.4g}, above {bound:.4g}, the largest that the rewards seen allow"

    def state(self) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {
            "returns": list(self.returns),
            "history": self.history.state(),
            "episodes": self.episodes,
            "diagnostics": self.diagnostics.state(),
            "largest_reward": self.largest_reward,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `state`."""
        self.returns.extend(state["returns"])
        self.episodes = state["episodes"]
        self.history.load_state(state["history"])
        self.diagnostics.load_state(state["diagnostics"])
        self.largest_reward = state["largest_reward"]

    def episode(self, episode_return: float) -> int:
        """Note a finished episode; return its number, from 0."""
        self.returns.append(episode_return)
        self.episodes += 1
        self.history.add(self.episodes, self.return_mean)
        return self.episodes - 1

    @property
    def return_mean(self) -> float:
        """Mean return of the last 100 episodes; 0 before the first."""
        return float(np.mean(self.returns)) if self.returns else 0.0

    @property
    def return_sd(self) -> float:
        """Standard deviation of the returns of the last 100 episodes."""
        return float(np.std(self.returns)) if self.returns else 0.0


def powers_of_two(values: NDArray[np.integer[Any]]) -> list[int]:
    """Count values by size: 0, 1, 2 to 3, 4 to 7, 8 to 15, ...

    values: int [n], at least 0. Entry b counts those of b binary digits, 2^(b - 1) to 2^b - 1; the last is not 0.
    """
    counts: list[int] = np.bincount(np.frexp(values)[1]).tolist()
    return counts


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
