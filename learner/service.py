"""The learner's loop in a distributed run: draw, update, broadcast, record; and how a run ends."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from common.messaging import messages
from common.messaging.clients import SampleClient, replay_key
from common.messaging.experience import Drawn
from common.messaging.messages import ReplayStats
from common.messaging.transport import NoAnswer, Node
from common.process.lifecycle import Stop
from common.settings import schedules
from learner.agent import Agent
from learner.broadcast import Broadcaster
from learner.checkpoints import Checkpoints
from learner.records.curve import draw_learning_curve
from learner.records.run_directory import RunDirectory
from learner.records.summary import Summary, summarise
from learner.records.telemetry import Telemetry
from learner.targets import target_reached

METRICS_EVERY = 200  # updates
STATUS_EVERY = 0.5  # seconds
REPLAY_BACK = 30.0  # seconds that a replay service may be away when the run is complete
FAREWELL = 5.0  # seconds that the others get to leave
NOTHING_DRAWN = Drawn(0, 0, 0, 0, 0, 0, ())


class LearnerService:
    """Trains an agent from a replay service until the run is complete or stopped.

    Args:
        state: of an epoch, from which to go on; the agent and the samples have been set back to it.
    """

    def __init__(
        self,
        node: Node,
        stop: Stop,
        agent: Agent,
        directory: RunDirectory,
        samples: SampleClient,
        checkpoints: Checkpoints,
        state: dict[str, Any] | None = None,
    ) -> None:
        self._node = node
        self._stop = stop
        self._agent = agent
        self._config = agent.config
        self._directory = directory
        self._samples = samples
        self._checkpoints = checkpoints
        self._telemetry = Telemetry()
        self._broadcaster = Broadcaster(node, agent)
        self._drawn = NOTHING_DRAWN
        self._started = time.monotonic()
        self._status_due = 0.0
        self._status: dict[str, Any] = {}
        self._missing: list[str] = []
        node.presence.on_change(self._look_round)
        self._speed = (self._started, agent.updates, 0.0)
        if state is not None:
            self._telemetry.load_state(state["telemetry"])
            self._drawn = Drawn(**state["drawn"], episodes=())
            self._started -= state["seconds"]

    def run(self) -> Summary:
        """Train to the end; the summary, as it is on disk.

        Raises:
            CoopError: the replay service found a request bad, gave an answer that is not one, or could not save itself.
        """
        outcome = ""
        try:
            while not (outcome := self._outcome()):
                self._turn()
            self._save()
        except Exception as error:
            outcome = f"failed: {error}"
            raise
        finally:
            self._checkpoints.wait()
            summary = self._finish(outcome)
        return summary

    def _turn(self) -> None:
        """One update, if there is a batch."""
        agent, settings = self._agent, self._config.learner
        got = self._samples.next()
        if got is not None:
            batch, self._drawn = got
            result = agent.update(batch)
            self._telemetry.add(agent, batch, result)
            if self._config.replay.prioritized:
                self._samples.prioritise(batch, np.abs(result.td_errors))
            if result.swapped or agent.updates % settings.publish_every == 0:
                self._broadcaster.publish()
            self._book_episodes()
            if agent.updates % METRICS_EVERY == 0:
                self._directory.metrics(self._telemetry.row(agent, self._drawn, self._epsilon()))
            self._checkpoints.begin_if_due(agent.updates, self._state)
        elif 0 < self._drawn.planned <= agent.updates and (stats := self._replay_stats()) is not None:
            # The last batch may have come before the last steps, and no other will tell of them.
            self._drawn = replace(self._drawn, inserted=stats.inserted, episodes=())
        if time.monotonic() >= self._status_due:
            self._tell()

    def _outcome(self) -> str:
        """Why the run is over; empty while it goes on."""
        config, agent = self._config, self._agent
        if self._stop.is_set():
            return self._stop.reason
        if agent.updates >= self._drawn.planned and self._drawn.inserted >= config.total_steps:
            return "complete"
        return target_reached(config, agent.updates, self._telemetry)

    def _book_episodes(self) -> None:
        for record in self._drawn.episodes:
            number = self._telemetry.episode(record.end.episode_return)
            self._directory.episode(number, record, self._agent.updates, self._agent.exploration_rate())

    def _epsilon(self) -> float:
        return schedules.epsilon(self._config.actor, self._drawn.inserted)

    def _tell(self) -> None:
        """Publish the status that displays show, and the role once more for those who missed it."""
        now = time.monotonic()
        then, updates, speed = self._speed
        if now - then >= STATUS_EVERY:
            speed = (self._agent.updates - updates) / (now - then)
            self._speed = (now, self._agent.updates, speed)
        self._status_due = now + STATUS_EVERY
        self._broadcaster.publish_role()
        self._status = {
            "env_steps": self._drawn.inserted,
            "total_steps": self._config.total_steps,
            "updates": self._agent.updates,
            "updates_per_s": speed,
            "acting": self._agent.acting + 1,
            "episodes": self._telemetry.episodes,
            "return_mean_100": self._telemetry.return_mean,
            "epsilon": self._epsilon(),
            "s": self._agent.exploration_rate(),
            "waiting": self._samples.waiting,
            "bad_messages": self._node.bad_messages,
            "connected": self._node.presence.counts(),
            "missing": self._node.presence.missing(),
        }
        self._node.publish_status(self._status)

    def _look_round(self) -> None:
        """Name those who have gone at once: the loop may be waiting for one of them."""
        missing = self._node.presence.missing()
        for name in set(missing) - set(self._missing):
            print(f"{name} does not answer", flush=True)
        if self._status and missing != self._missing:
            self._node.publish_status({**self._status, "connected": self._node.presence.counts(), "missing": missing})
        self._missing = missing

    def _save(self) -> None:
        """Save the closing epoch; there is none before the first update, or where the replay service is gone."""
        deadline = time.monotonic() + (0 if self._stop.is_set() else REPLAY_BACK)
        while self._replay_stats() is None:
            if time.monotonic() >= deadline:
                return
            time.sleep(STATUS_EVERY)
        if self._agent.updates:
            self._checkpoints.save(self._state())

    def _finish(self, outcome: str) -> Summary:
        """Collect the last counters, write the summary, and send everybody home."""
        self._node.presence.on_change(lambda: None)
        try:
            stats = self._replay_stats()
            steps, lost, duplicates = (
                (self._drawn.inserted, None, None) if stats is None else (stats.inserted, stats.lost, stats.duplicates)
            )
            summary = summarise(self._agent, self._telemetry, self._started, outcome, steps, lost, duplicates)
            self._directory.summary(summary)
            draw_learning_curve(self._directory.path, summary.title)
        finally:
            self._farewell(outcome)
        return summary

    def _replay_stats(self) -> ReplayStats | None:
        question = messages.encode_question(self._node.run, "stats")
        try:
            return messages.decode_stats(self._node.ask(replay_key(self._node, "stats"), question))
        except NoAnswer:
            return None

    def _state(self) -> dict[str, Any]:
        return {
            "agent": self._agent.state(),
            "telemetry": self._telemetry.state(),
            "drawn": {name: value for name, value in asdict(self._drawn).items() if name != "episodes"},
            "told": self._samples.episodes,
            "sizes": self._directory.sizes(),
            "seconds": time.monotonic() - self._started,
        }

    def _farewell(self, outcome: str) -> None:
        """Announce the stop until the other roles have gone, or their time is up."""
        deadline = time.monotonic() + FAREWELL
        while time.monotonic() < deadline:
            self._node.announce(self._node.key("stop"), messages.encode_stop(self._node.run, outcome))
            time.sleep(0.1)
            alive = self._node.presence.counts()
            if not alive.get("actor") and not alive.get("replay"):
                return
