"""Follows the learner's broadcasts, and keeps a policy's networks and acting role up to date."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from typing import TypeVar

import numpy as np

from coop.actors.policy import EpsilonGreedy
from coop.common.errors import BadMessage, JoinError
from coop.common.imports import check_allowed
from coop.common.messaging.conversation import Conversation, asking, drive
from coop.common.messaging.keys import role_key, weights_key
from coop.common.messaging.messages.control import JoinReply
from coop.common.messaging.messages.weights import Current, Role, Weights
from coop.common.messaging.timing import ANSWER_TIMEOUT, GRACE
from coop.common.messaging.transport import NoAnswer, Node
from coop.common.messaging.wire import Message
from coop.common.networks.acting import acting_network

T = TypeVar("T")
UNKNOWN = -1  # a version: no weights, or no role, received yet


class WeightsFollower:
    """Loads broadcast weights into a policy.

    version: of the parameters that act now. progress: updates and environment steps of the run when the networks that
    the newest role names were broadcast.
    """

    def __init__(self, node: Node, policy: EpsilonGreedy) -> None:
        self._node = node
        self._policy = policy
        self._size = policy.networks[0].size
        self._held = [UNKNOWN, UNKNOWN]
        self._told = [UNKNOWN, UNKNOWN]
        self.progress = (0, 0)
        self._ask_at = math.inf  # monotonic time; inf while nothing is missing
        self._keys = [weights_key(node, 1), weights_key(node, 2)]
        self._weights = [node.latest(key) for key in self._keys]
        self._role = node.latest(role_key(node))

    @property
    def version(self) -> int:
        """Version of the acting network's parameters."""
        return self._held[self._policy.acting]

    @property
    def ready(self) -> bool:
        """True once both networks have been received, and which one acts."""
        return UNKNOWN not in (*self._held, *self._told)

    @property
    def settled(self) -> bool:
        """True if the acting network is just the one that the newest role names."""
        return self.ready and self.version == self._told[self._policy.acting]

    def refresh(self) -> None:
        """Load new broadcasts; ask the learner for weights whose broadcast did not arrive."""
        drive(self.refreshing())

    def refreshing(self) -> Conversation[None]:
        """See `refresh`."""
        for follower in self._weights:
            self._load(follower.poll())
        self._follow(self._role.poll())
        if not self.ready:
            yield from self.fetching()
        elif self._held[self._policy.acting] >= self._told[self._policy.acting]:
            self._ask_at = math.inf
        else:
            now = self._node.now()
            self._ask_at = min(self._ask_at, now + GRACE)
            if now >= self._ask_at:
                self._ask_at = math.inf
                yield from self.fetching()

    def fetch(self) -> bool:
        """Ask the learner for both networks and the role; False if it does not answer."""
        return drive(self.fetching())

    def fetching(self) -> Conversation[bool]:
        """See `fetch`."""
        question = Current().encode(self._node.run)
        try:
            for key, follower in zip(self._keys, self._weights, strict=True):
                answer = yield from asking(self._node, key, question, ANSWER_TIMEOUT)
                self._load(answer, follower.poll())
            answer = yield from asking(self._node, role_key(self._node), question, ANSWER_TIMEOUT)
            self._follow(answer, self._role.poll())
        except NoAnswer:
            return False
        return True

    def _load(self, *messages: Message | None) -> None:
        """Load the newest of weights that came in any order: an answer, and a broadcast meanwhile."""
        found = self._read(messages, "weights", lambda message: Weights.decode(message, self._size))
        if found:
            weights = max(found, key=lambda each: each.version)
            self._policy.networks[weights.network - 1].load(weights.flat)
            self._held[weights.network - 1] = weights.version

    def _follow(self, *messages: Message | None) -> None:
        """Follow the newest of roles that came in any order."""
        found = self._read(messages, "role", Role.decode)
        if found:
            role = max(found, key=lambda each: each.updates)
            self._told = list(role.versions)
            self.progress = role.updates, role.env_step
            self._policy.acting = role.acting - 1

    def _read(self, messages: Iterable[Message | None], name: str, decode: Callable[[Message], T]) -> list[T]:
        """Those that can be read; the others are counted."""
        found = []
        for message in messages:
            try:
                if message is not None:
                    found.append(decode(message))
            except BadMessage as error:
                self._node.count_bad(self._node.key(name), error)
        return found


def make_policy(
    reply: JoinReply, allow_import: Collection[str], rng: np.random.Generator, device: str = "cpu"
) -> EpsilonGreedy:
    """A policy with networks of the run's layout on a device; the learner will send their parameters.

    Raises:
        JoinError: the run needs a module that this process may not import, or this process builds another layout than
            the learner does.
    """
    for field, path in reply.config.imports.items():
        check_allowed(path, allow_import, field)
    first, second = (acting_network(reply.config.network, reply.spec, device) for _ in range(2))
    if first.layout_digest() != reply.layout:
        raise JoinError(f"network layout here {first.layout_digest()}, the learner's {reply.layout}")
    return EpsilonGreedy((first, second), reply.spec, rng)
