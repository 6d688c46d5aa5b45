"""Publishes the learner's status for displays, with what the other roles report of themselves."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from coop.common.errors import BadMessage
from coop.common.messaging.keys import incarnation_of, status_key
from coop.common.messaging.members import Origin
from coop.common.messaging.messages.status import (
    MAX_MEMBERS,
    ActorStatus,
    Held,
    LearnerStatus,
    Measured,
    Member,
    ReplayStatus,
    Wait,
)
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.transport import Node
from coop.common.messaging.wire import Message
from coop.common.metrics import MEASURED
from coop.common.numbers import Rate, finite
from coop.common.process.console import Console
from coop.learner.join_service import JoinService
from coop.learner.trainer import Trainer

SPEED_OVER = 2.0  # seconds
TIME_LEFT_OVER = 30.0  # seconds whose speed gives the time left
MEMBERS_EVERY = 0.1  # seconds between statuses for the sake of members alone
SHORTEST_WAIT = 0.05  # share of the time below which nobody counts as waiting


class StatusReporter:
    """Gathers the statuses of the other roles, and publishes the learner's.

    status: the newest that `publish` has published; None before the first.
    """

    def __init__(
        self, node: Node, trainer: Trainer, samples: SampleClient, join_service: JoinService, console: Console
    ) -> None:
        self._node = node
        self._trainer = trainer
        self._samples = samples
        self._join_service = join_service
        self._console = console
        self.status: LearnerStatus | None = None
        self._members_due = 0.0
        self._origin = Origin.here()
        self._steps_per_s, self._updates_per_s = Rate(SPEED_OVER), Rate(SPEED_OVER)
        self._slow_steps_per_s, self._slow_updates_per_s = Rate(TIME_LEFT_OVER), Rate(TIME_LEFT_OVER)
        self._replay = node.latest(status_key(node, "replay"))
        self._replay_status: ReplayStatus | None = None
        node.on(status_key(node, "actor"), "reading an actor's status", self._on_actor)

    def publish(self, now: float) -> LearnerStatus:
        """Publish the present status; return it."""
        trainer, agent, config = self._trainer, self._trainer.agent, self._trainer.config
        members, metrics, updates = self._members(now), trainer.metrics, agent.updates
        # What the replay service says is newer, and all that there is before the first draw.
        size, steps, replay = trainer.drawn.size, trainer.drawn.inserted, self._replay_status
        if replay is not None:
            size, steps = replay.size, max(steps, replay.inserted)
        self.status = LearnerStatus(
            env_steps=steps,
            total_steps=config.total_steps,
            updates=updates,
            updates_per_s=self._updates_per_s.at(now, updates),
            acting=agent.acting + 1,
            episodes=trainer.telemetry.episodes,
            return_mean_100=trainer.telemetry.return_mean,
            epsilon=trainer.epsilon(),
            s=agent.feedback_scale(),
            waiting=self._samples.waiting,
            warning=trainer.telemetry.warning(agent),
            origin=str(self._origin),
            env=config.env.id,
            method=config.method,
            seed=config.seed,
            seconds=trainer.seconds(now),
            seconds_left=self._seconds_left(now, steps),
            env_steps_per_s=self._steps_per_s.at(now, steps),
            two_networks=config.two_networks,
            updates_to_swap=config.swap_period - updates % config.swap_period,
            size=size,
            capacity=config.replay.capacity,
            return_history=trainer.telemetry.history.values,
            measured=None if metrics is None else measured(metrics),
            bad_messages=self._node.bad_messages,
            faults=self._node.faults.count,
            **members,
        )
        self._node.publish_status(self.status)
        return self.status

    def publish_members(self, now: float) -> None:
        """Publish the last status again, with the present members; may be called by another thread.

        Not at each call, if there are many: the next status of `publish` has what is left out.
        """
        if self.status is not None and now >= self._members_due:
            self._members_due = now + MEMBERS_EVERY
            self._node.publish_status(msgspec.structs.replace(self.status, **self._members(now)))

    def _members(self, now: float) -> dict[str, Any]:
        """The fields that say who is there, who waits and why."""
        self._read_replay()
        connected, members = self._join_service.connected(), self._join_service.members
        waiting = self._samples.waiting
        learner = Member("learner", "learner", *self._origin, "waiting" if waiting else "training", reason=waiting)
        replay = self._replay_status if connected["replay"] else None
        others = members.listed(now, MAX_MEMBERS - 1)
        return {
            "connected": connected,
            "missing": members.missing(now),
            "events": self._console.recent(),
            "members": _with_learner(learner, others),
            "ratio": None if replay is None else replay.ratio,
            "waits": waits(replay, waiting, others),
        }

    def _read_replay(self) -> None:
        message = self._replay.poll()
        if message is not None:
            try:
                self._replay_status = ReplayStatus.decode(message)
            except BadMessage as error:
                self._node.count_bad(status_key(self._node, "replay"), error)

    def _on_actor(self, key: str, message: Message) -> None:
        self._join_service.members.report(incarnation_of(key), ActorStatus.decode(message))

    def _seconds_left(self, now: float, steps: int) -> float | None:
        """Estimate from the speed of the last half minute; None while nothing moves."""
        trainer, config, updates = self._trainer, self._trainer.config, self._trainer.agent.updates
        steps_per_s, updates_per_s = self._slow_steps_per_s.at(now, steps), self._slow_updates_per_s.at(now, updates)
        planned = trainer.drawn.planned or config.planned_updates
        left = max(_seconds(config.total_steps - steps, steps_per_s), _seconds(planned - updates, updates_per_s))
        if config.total_updates:
            left = min(left, _seconds(config.total_updates - updates, updates_per_s))
        return left if math.isfinite(left) else None


def _with_learner(learner: Member, others: list[Member]) -> list[Member]:
    """The lost members, the learner, and the others."""
    lost = sum(member.state == "lost" for member in others)
    return [*others[:lost], learner, *others[lost:]]


def waits(replay: ReplayStatus | None, learner: str, members: list[Member]) -> list[Wait]:
    """Who waits for whom.

    replay: the status of the service that is there. learner: why the learner waits, in words. members: the actors.
    """
    found = []
    if replay is not None:
        found += _held("actors", "the learner", replay.inserts) + _held("the learner", "actors", replay.samples)
    if learner and not any(wait.who == "the learner" for wait in found):
        found.append(_wait("the learner", "actors" if replay else "", 1.0, learner))
    reason = next((member.reason for member in members if member.reason), "")
    if reason and not any(wait.who == "actors" for wait in found):
        found.append(_wait("actors", "the learner" if replay else "", 1.0, reason))
    return found


def _held(who: str, for_whom: str, held: Held) -> list[Wait]:
    return [_wait(who, for_whom, held.share, held.reason)] if held.share >= SHORTEST_WAIT else []


def _wait(who: str, other: str, share: float, reason: str) -> Wait:
    """Someone's wait for the other side, or for the replay service if that is not there or cannot write its journal."""
    serves = other and "replay service" not in reason and "journal" not in reason
    return Wait(who, other if serves else "the replay service", share, reason)


def measured(metrics: dict[str, Any]) -> Measured:
    """What a status carries of a row of metrics.jsonl; a number that is not finite is not known."""
    return Measured(**{name: finite(metrics[name]) for name in MEASURED if name in metrics})


def _seconds(count: int, per_second: float) -> float:
    if count <= 0:
        return 0.0
    return count / per_second if per_second > 0 else math.inf
