"""The training loop without I/O: batches and the time are arguments, effects are return values.

Distributed and lockstep runs use the same trainer; they differ in where batches come from and how the effects are
carried out.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from coop.common.numbers import METRICS_EVERY
from coop.common.transitions import Batch, Drawn
from coop.common.types import EpisodeRow
from coop.learner.agent import Update
from coop.learner.protocol import AnyAgent
from coop.learner.telemetry import Telemetry

NOTHING_DRAWN = Drawn(0, 0, 0, 0, 0, 0, ())


@dataclass(frozen=True, slots=True)
class Effects:
    """The effects of one batch, for the caller to carry out.

    broadcast: send the networks and the role to the actors.
    priorities: float32 [n], new priorities of the transitions numbered ids, int64 [n]; None if the table does not use
        them, or they are not yet known.
    episodes: rows for episodes.csv. metrics: the row of an interval that ends here, or None.
    """

    broadcast: bool = False
    priorities: NDArray[np.float32] | None = None
    ids: NDArray[np.int64] | None = None
    episodes: Sequence[EpisodeRow] = ()
    metrics: dict[str, Any] | None = None


class Trainer:
    """Trains an agent, and keeps the run's counters and metrics.

    Args:
        now: seconds of a monotonic clock, here and below.

    Attributes:
        drawn: the replay side's counters as last received, without episodes.
        metrics: the newest row of an interval; None before the first.
        diverged: which values are no longer finite, in words; empty if all are finite.

    What a GPU measures in an update is read `agent.lag` updates later, so that neither waits for the other; where a
    broadcast, a row or a checkpoint is due it is read at once.
    """

    def __init__(self, agent: AnyAgent, now: float) -> None:
        self.agent = agent
        self.config = agent.config
        self.telemetry = Telemetry(now)
        self.drawn = NOTHING_DRAWN
        self.metrics: dict[str, Any] | None = None
        self._began = now
        self.diverged = ""
        self._unread: deque[tuple[int, NDArray[np.int64], Update]] = deque()
        self._next_checkpoint = agent.updates + self._checkpoint_every

    def train(self, batch: Batch, drawn: Drawn, now: float) -> Effects:
        """Update the acting network from a batch, with the counters and episodes in `drawn`."""
        agent = self.agent
        update = agent.update(batch)
        self.telemetry.add(agent, batch)
        self._unread.append((agent.updates, batch.ids, update))
        broadcast = update.swapped or agent.updates % self.config.learner.publish_every == 0
        row = agent.updates % METRICS_EVERY == 0
        ids, priorities = self._read(0 if broadcast or row or agent.updates >= self._next_checkpoint else agent.lag)
        if broadcast and not self.diverged and not agent.finite():
            self.diverged = f"diverged: parameters are not finite at update {agent.updates}"
        return Effects(
            broadcast=broadcast and not self.diverged,
            priorities=priorities,
            ids=ids,
            episodes=self._number_episodes(drawn),
            metrics=self._metrics(now) if row else None,
        )

    def _read(self, keep: int) -> tuple[NDArray[np.int64] | None, NDArray[np.float32] | None]:
        """Read what updates have measured, but the newest: transitions' numbers, and their new priorities."""
        ids, priorities = [], []
        while len(self._unread) > keep:
            number, drawn, update = self._unread.popleft()
            errors = update.td_errors
            self.telemetry.add_errors(errors)
            if not self.diverged and not np.isfinite(errors).all():
                self.diverged = f"diverged: TD errors are not finite at update {number}"
            ids.append(drawn)
            priorities.append(np.abs(errors))
        if not priorities or not self.config.replay.prioritized or self.diverged:
            return None, None
        return (ids[0], priorities[0]) if len(ids) == 1 else (np.concatenate(ids), np.concatenate(priorities))

    def receive(self, drawn: Drawn) -> Effects:
        """Process counters and episodes that arrived without a batch."""
        return Effects(episodes=self._number_episodes(drawn))

    def outcome(self) -> str:
        """Why the run is over; empty while it continues."""
        config, agent, telemetry = self.config, self.agent, self.telemetry
        if self.diverged:
            return self.diverged
        if agent.updates >= self.drawn.planned and self.drawn.inserted >= config.total_steps:
            return "complete"
        if 0 < config.total_updates <= agent.updates:
            return "complete: total_updates reached"
        if 0 < config.total_episodes <= telemetry.episodes:
            return "complete: total_episodes reached"
        target, full = config.target_return, len(telemetry.returns) == telemetry.returns.maxlen
        if target is not None and full and telemetry.return_mean >= target:
            return "complete: target_return reached"
        return ""

    def all_updates_done(self) -> bool:
        """True once every planned update is done, so that no further batch brings the counters of the last steps."""
        return 0 < self.drawn.planned <= self.agent.updates

    def checkpoint_due(self) -> bool:
        """True if a checkpoint should begin now; it stays due until `checkpoint_begun`."""
        return self.agent.updates >= self._next_checkpoint and self.saveable()

    def ask_checkpoint(self) -> None:
        """Make a checkpoint due after the next update."""
        self._next_checkpoint = min(self._next_checkpoint, self.agent.updates + 1)

    def checkpoint_begun(self) -> None:
        """Count updates to the next checkpoint from here."""
        self._next_checkpoint = self.agent.updates + self._checkpoint_every

    def saveable(self) -> bool:
        """True while the agent may be saved; a diverged state must not be resumed."""
        self._read(0)
        if not self.diverged and not self.agent.finite():
            self.diverged = f"diverged: parameters are not finite at update {self.agent.updates}"
        return not self.diverged

    def epsilon(self) -> float:
        """The actors' epsilon at the environment steps last received."""
        return self.agent.epsilon(self.drawn.inserted)

    def seconds(self, now: float) -> float:
        """Seconds that the run has taken, over all its resumptions."""
        return now - self._began

    def state(self, now: float) -> dict[str, Any]:
        """The state for `load_state`; torch.load reads it with weights_only."""
        return {
            "agent": self.agent.state(),
            "telemetry": self.telemetry.state(),
            "drawn": {name: value for name, value in msgspec.structs.asdict(self.drawn).items() if name != "episodes"},
            "seconds": self.seconds(now),
            "spec": msgspec.structs.asdict(self.agent.spec),
        }

    def load_state(self, state: dict[str, Any], now: float) -> None:
        """Restore a state from `state`."""
        self.agent.load_state(state["agent"])
        self.telemetry.load_state(state["telemetry"])
        self.drawn = Drawn(**state["drawn"], episodes=())
        self._began = now - state["seconds"]
        self.checkpoint_begun()

    @property
    def _checkpoint_every(self) -> float:
        return self.config.checkpoint_every or math.inf

    def _number_episodes(self, drawn: Drawn) -> list[EpisodeRow]:
        """Store the counters, and number the episodes."""
        self.drawn = drawn
        if not drawn.episodes:
            return []
        self.drawn = msgspec.structs.replace(drawn, episodes=())
        number, updates, s = self.telemetry.episode, self.agent.updates, self.agent.feedback_scale()
        return [EpisodeRow(number(record.end.episode_return), record, updates, s) for record in drawn.episodes]

    def _metrics(self, now: float) -> dict[str, Any] | None:
        """The row of the interval that ends here, or None if the agent's values are not finite."""
        with np.errstate(all="ignore"):  # what is not finite is found below
            row = self.telemetry.row(self.agent, self.drawn, self.epsilon(), now)
        bad = [name for name, value in row.items() if isinstance(value, float) and not math.isfinite(value)]
        if bad and not self.diverged:
            self.diverged = f"diverged: {bad[0]} is not finite at update {self.agent.updates}"
        if bad:
            return None
        self.metrics = row
        return row
