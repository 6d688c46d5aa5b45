"""The actor's loop: act, step the emulators, send segments."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from actors.policy import Policy
from actors.segments import EpisodeTracker, SegmentAssembler
from actors.weights import WeightsFollower
from common.envs.protocol import Steps, VectorEnv
from common.messaging.clients import InsertClient
from common.messaging.route import ReplayRoute
from common.messaging.transport import Node
from common.process.lifecycle import Stop
from common.settings import schedules
from common.settings.config import RunConfig
from common.types import Array, EpisodeEnd

STATUS_EVERY = 0.5  # seconds


class _Played(NamedTuple):
    """One step of all emulators, and what chose its actions."""

    actions: NDArray[np.int32]
    steps: Steps
    epsilon: float
    version: int


class ActorService:
    """Plays all emulators of one process until the stop."""

    def __init__(
        self,
        node: Node,
        route: ReplayRoute,
        stop: Stop,
        config: RunConfig,
        env: VectorEnv,
        policy: Policy,
        incarnation: int,
    ) -> None:
        self._node = node
        self._stop = stop
        self._settings = settings = config.actor
        self._env = env
        self._policy = policy
        self._weights = WeightsFollower(node, policy)
        self._inserts = InsertClient(route, stop, settings.window * env.num_envs, self._tell)
        self._segments = SegmentAssembler(
            env.spec,
            env.num_envs,
            incarnation,
            settings.segment_steps,
            n_step=config.replay.n_step,
            gamma=config.learner.gamma,
        )
        self._episodes = EpisodeTracker(env.num_envs)
        self._played: _Played | None = None
        self._steps = 0
        self._status_due = 0.0

    def run(self) -> None:
        """Play until the stop; what has not filled a segment by then is dropped."""
        while not self._weights.ready:
            self._weights.refresh()
            self._tell()
            if self._stop.wait(0.05):
                return
        obs = self._env.reset()
        self._segments.begin(obs)
        while not self._stop.is_set():
            obs = self._turn(obs)
            self._tell()

    def _turn(self, obs: Array) -> Array:
        """One step of all emulators; what they see next. They work while the step before is handed in."""
        self._weights.refresh()
        epsilon = schedules.epsilon(self._settings, self._inserts.inserted)
        actions = self._policy.act(obs, epsilon)
        self._env.send(actions)
        if self._played is not None:
            self._hand_in(self._played)
        steps = self._env.recv()
        self._played = _Played(actions, steps, epsilon, self._weights.version)
        self._steps += self._env.num_envs
        return steps.obs

    def _hand_in(self, played: _Played) -> None:
        """Add a step to the segments, and send those that it filled."""
        ends = {}
        for episode in self._episodes.add(played.steps):
            q1_mean, q2_mean = self._policy.mean_values(played.steps.next_obs[episode.stream])
            ends[episode.stream] = EpisodeEnd(
                0, episode.episode_return, episode.length, played.epsilon, q1_mean, q2_mean, played.version
            )
        for segment in self._segments.add(played.actions, played.steps, played.version, ends):
            if not self._inserts.submit(segment):
                break

    def _tell(self) -> None:
        """Publish the status if it is due; while an insert waits, too."""
        now = time.monotonic()
        if now < self._status_due:
            return
        self._status_due = now + STATUS_EVERY
        self._node.publish_status({"steps": self._steps, "acked": self._inserts.acked, "waiting": self._waiting()})

    def _waiting(self) -> str:
        return self._inserts.waiting if self._weights.ready else "waiting for the learner's weights"
