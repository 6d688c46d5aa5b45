"""What a learner does with a batch, decided without I/O: time comes in as an argument, effects go out as values.

Distributed runs and lockstep runs drive the same trainer; what differs is where batches come from and how the effects
are carried out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from common.messaging.messages.sample import Drawn, EpisodeRecord
from common.settings import schedules
from common.types import Batch
from learner.agent import Agent
from learner.telemetry import Telemetry

METRICS_EVERY = 200  # updates
NOTHING_DRAWN = Drawn(0, 0, 0, 0, 0, 0, ())


class EpisodeRow(NamedTuple):
    """One finished episode, as it is written down: its number, what the actor told, updates done, rate of s."""

    number: int
    record: EpisodeRecord
    update: int
    s: float


@dataclass(frozen=True, slots=True)
class Effects:
    """What follows from one batch.

    broadcast: the networks and the role are to be sent to the actors.
    priorities: float32 [batch], new priorities of the batch's transitions; None where sampling does not ask for them.
    episodes: to be written down. metrics: the row of an interval that ends here.
    """

    broadcast: bool = False
    priorities: NDArray[np.float32] | None = None
    episodes: Sequence[EpisodeRow] = ()
    metrics: dict[str, Any] | None = None


class Trainer:
    """Trains an agent and keeps the run's account.

    Args:
        now: seconds of a monotonic clock, here and below.

    Attributes:
        drawn: the counters of the replay side as told last, without episodes.
        diverged: what is no longer finite, in words; empty while all is.
    """

    def __init__(self, agent: Agent, now: float) -> None:
        self.agent = agent
        self.config = agent.config
        self.telemetry = Telemetry(now)
        self.drawn = NOTHING_DRAWN
        self._began = now
        self.diverged = ""
        self._next_epoch = agent.updates + self._epoch_every

    def train(self, batch: Batch, drawn: Drawn, now: float) -> Effects:
        """Update the acting network from a batch; `drawn` came with it."""
        agent = self.agent
        update = agent.update(batch)
        self.telemetry.add(agent, batch, update)
        if not np.isfinite(update.td_errors).all():
            self.diverged = f"diverged: TD errors are not finite at update {agent.updates}"
        broadcast = update.swapped or agent.updates % self.config.learner.publish_every == 0
        if broadcast and not self.diverged and not agent.finite():
            self.diverged = f"diverged: parameters are not finite at update {agent.updates}"
        return Effects(
            broadcast=broadcast and not self.diverged,
            priorities=np.abs(update.td_errors) if self.config.replay.prioritized and not self.diverged else None,
            episodes=self._book(drawn),
            metrics=self._metrics(now) if agent.updates % METRICS_EVERY == 0 else None,
        )

    def note(self, drawn: Drawn) -> Effects:
        """Take in counters and episodes that came without a batch."""
        return Effects(episodes=self._book(drawn))

    def outcome(self) -> str:
        """Why the run is over; empty while it goes on."""
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

    def trained_out(self) -> bool:
        """True once every planned update is done: no batch will tell of the steps that are still to come."""
        return 0 < self.drawn.planned <= self.agent.updates

    def epoch_due(self) -> bool:
        """True where an epoch is to be begun now; it stays due until `epoch_begun`."""
        return self.agent.updates >= self._next_epoch and self.sound()

    def epoch_begun(self) -> None:
        """Count from here to the next epoch."""
        self._next_epoch = self.agent.updates + self._epoch_every

    def sound(self) -> bool:
        """True while the agent may be saved: a state that diverged is no state to go on from."""
        if not self.diverged and not self.agent.finite():
            self.diverged = f"diverged: parameters are not finite at update {self.agent.updates}"
        return not self.diverged

    def epsilon(self) -> float:
        """The actors' epsilon after the steps told last."""
        return schedules.epsilon(self.config.actor, self.drawn.inserted)

    def seconds(self, now: float) -> float:
        """How long the run has gone on, over all its resumptions."""
        return now - self._began

    def state(self, now: float) -> dict[str, Any]:
        """Everything that `load_state` needs; loads with weights_only."""
        return {
            "agent": self.agent.state(),
            "telemetry": self.telemetry.state(),
            "drawn": {name: value for name, value in msgspec.structs.asdict(self.drawn).items() if name != "episodes"},
            "seconds": self.seconds(now),
        }

    def load_state(self, state: dict[str, Any], now: float) -> None:
        """Go on where `state` was taken."""
        self.agent.load_state(state["agent"])
        self.telemetry.load_state(state["telemetry"])
        self.drawn = Drawn(**state["drawn"], episodes=())
        self._began = now - state["seconds"]
        self.epoch_begun()

    @property
    def _epoch_every(self) -> float:
        return self.config.checkpoint_every or math.inf

    def _book(self, drawn: Drawn) -> list[EpisodeRow]:
        """Keep the counters, and number the episodes."""
        self.drawn = msgspec.structs.replace(drawn, episodes=()) if drawn.episodes else drawn
        number, updates, s = self.telemetry.episode, self.agent.updates, self.agent.exploration_rate()
        return [EpisodeRow(number(record.end.episode_return), record, updates, s) for record in drawn.episodes]

    def _metrics(self, now: float) -> dict[str, Any] | None:
        """The row of the interval that ends here; none where the agent's values are not finite."""
        row = self.telemetry.row(self.agent, self.drawn, self.epsilon(), now)
        bad = [name for name, value in row.items() if isinstance(value, float) and not math.isfinite(value)]
        if bad and not self.diverged:
            self.diverged = f"diverged: {bad[0]} is not finite at update {self.agent.updates}"
        return None if bad else row
