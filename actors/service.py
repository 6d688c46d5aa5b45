"""Connects players to Zenoh: receives weights, sends segments."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from coop.actors.player import Player
from coop.actors.policy import EpsilonGreedy
from coop.actors.segments import SegmentAssembler
from coop.actors.weights import WeightsFollower
from coop.common.envs.protocol import VectorEnv
from coop.common.messaging.conversation import Asker
from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.messages.status import ActorStatus
from coop.common.messaging.timing import STATUS_EVERY
from coop.common.messaging.transport import Node
from coop.common.numbers import Rate
from coop.common.process.console import Console
from coop.common.process.lifecycle import Stop
from coop.common.settings import schedules
from coop.common.settings.config import RunConfig

SPEED_OVER = 2.0  # seconds


@dataclass(frozen=True)
class _Emulators:
    """Emulators that step together."""

    player: Player
    segments: SegmentAssembler


class ActorService:
    """Plays all emulators of one process until the stop, and sends their segments to the replay service.

    Args:
        envs: groups of emulators, which act in turn: those of one play while the network chooses for another.
    """

    def __init__(
        self,
        node: Node,
        route: Asker,
        stop: Stop,
        config: RunConfig,
        envs: Sequence[VectorEnv],
        policy: EpsilonGreedy,
        incarnation: int,
        console: Console,
    ) -> None:
        self._console = console
        self._node = node
        self._stop = stop
        settings = config.actor
        self._weights = WeightsFollower(node, policy)
        self._groups: list[_Emulators] = []
        emulators = 0
        for env in envs:
            segments = SegmentAssembler(
                env.spec,
                env.num_envs,
                incarnation,
                settings.segment_steps,
                n_step=config.replay.n_step,
                gamma=config.learner.gamma,
                first_stream=emulators,
            )
            self._groups.append(_Emulators(Player(env, policy, partial(schedules.epsilon, settings)), segments))
            emulators += env.num_envs
        self._inserts = InsertClient(route, stop, settings.max_in_flight * emulators, self._publish_status)
        self._status_due = 0.0
        self._speed = Rate(SPEED_OVER)

    def run(self) -> None:
        """Play until the stop; steps that have not filled a segment by then are dropped."""
        while not self._weights.ready:
            self._weights.refresh()
            self._publish_status()
            if self._stop.wait(0.05):
                return
        for group in self._groups:
            group.segments.begin(group.player.begin())
            self._act(group)
        while not self._stop.is_set():
            self._weights.refresh()
            for group in self._groups:
                self._play(group)
            self._publish_status()
        for group in self._groups:
            group.player.recv()

    def _act(self, group: _Emulators) -> None:
        group.player.send(self._inserts.inserted, self._weights.version)

    def _play(self, group: _Emulators) -> None:
        """Play one step of a group; its emulators work while the step before is sent, and while other groups act."""
        turn = group.player.recv()
        self._act(group)
        for segment in group.segments.add(turn.actions, turn.steps, turn.version, turn.ended):
            if not self._inserts.submit(segment):
                break

    def _publish_status(self) -> None:
        """Publish the status if it is due; also called while an insert waits."""
        now = time.monotonic()
        if now < self._status_due:
            return
        self._status_due = now + STATUS_EVERY
        speed = self._speed.at(now, self._steps)
        self._node.publish_status(ActorStatus(self._steps, self._inserts.acked, speed, self._waiting()))
        self._console.progress(self._inserts.acked, self._waiting(), self.progress)

    @property
    def _steps(self) -> int:
        return sum(group.player.steps for group in self._groups)

    def progress(self) -> str:
        """This actor's progress in one line."""
        return f"{self._steps:,} steps played, {self._inserts.acked:,} of them acknowledged"

    def _waiting(self) -> str:
        return self._inserts.waiting if self._weights.ready else "waiting for the learner's weights"
