"""Connects a player to Zenoh: receives weights, sends segments."""

from __future__ import annotations

import time
from functools import partial

from coop.actors.player import Player, Turn
from coop.actors.policy import EpsilonGreedy
from coop.actors.segments import SegmentAssembler
from coop.actors.weights import WeightsFollower
from coop.common.envs.protocol import VectorEnv
from coop.common.messaging.insert_client import InsertClient, QuerySender
from coop.common.messaging.messages.status import ActorStatus
from coop.common.messaging.transport import Node
from coop.common.numbers import Rate
from coop.common.process.console import Console
from coop.common.process.lifecycle import Stop
from coop.common.settings import schedules
from coop.common.settings.config import RunConfig

STATUS_EVERY = 0.5  # seconds
SPEED_OVER = 2.0  # seconds


class ActorService:
    """Plays all emulators of one process until the stop, and sends their segments to the replay service."""

    def __init__(
        self,
        node: Node,
        route: QuerySender,
        stop: Stop,
        config: RunConfig,
        env: VectorEnv,
        policy: EpsilonGreedy,
        incarnation: int,
        console: Console,
    ) -> None:
        self._console = console
        self._node = node
        self._stop = stop
        settings = config.actor
        self._player = Player(env, policy, partial(schedules.epsilon, settings))
        self._weights = WeightsFollower(node, policy)
        self._inserts = InsertClient(route, stop, settings.max_in_flight * env.num_envs, self._publish_status)
        self._segments = SegmentAssembler(
            env.spec,
            env.num_envs,
            incarnation,
            settings.segment_steps,
            n_step=config.replay.n_step,
            gamma=config.learner.gamma,
        )
        self._turn: Turn | None = None
        self._status_due = 0.0
        self._speed = Rate(SPEED_OVER)

    def run(self) -> None:
        """Play until the stop; steps that have not filled a segment by then are dropped."""
        while not self._weights.ready:
            self._weights.refresh()
            self._publish_status()
            if self._stop.wait(0.05):
                return
        self._segments.begin(self._player.begin())
        while not self._stop.is_set():
            self._play()
            self._publish_status()

    def _play(self) -> None:
        """Play one step of all emulators; they work while the previous step is sent."""
        self._weights.refresh()
        self._player.send(self._inserts.inserted, self._weights.version)
        if self._turn is not None:
            self._send(self._turn)
        self._turn = self._player.recv()

    def _send(self, turn: Turn) -> None:
        """Add a step to the segments, and send those that it completes."""
        for segment in self._segments.add(turn.actions, turn.steps, turn.version, turn.ended):
            if not self._inserts.submit(segment):
                break

    def _publish_status(self) -> None:
        """Publish the status if it is due; also called while an insert waits."""
        now = time.monotonic()
        if now < self._status_due:
            return
        self._status_due = now + STATUS_EVERY
        speed = self._speed.at(now, self._player.steps)
        self._node.publish_status(ActorStatus(self._player.steps, self._inserts.acked, speed, self._waiting()))
        self._console.progress(self._inserts.acked, self._waiting(), self.progress)

    def progress(self) -> str:
        """This actor's progress in one line."""
        return f"{self._player.steps:,} steps played, {self._inserts.acked:,} of them acknowledged"

    def _waiting(self) -> str:
        return self._inserts.waiting if self._weights.ready else "waiting for the learner's weights"
