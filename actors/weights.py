"""Follows the learner's broadcasts: keeps a policy's networks and acting role up to date."""

from __future__ import annotations

import time

from actors.policy import Policy
from common.errors import BadMessage
from common.messaging import messages
from common.messaging.transport import NoAnswer, Node
from common.messaging.wire import Message

GRACE = 0.5  # seconds that a broadcast may take before the weights are asked for


class WeightsFollower:
    """Loads new weights into a policy.

    version: of the parameters that act now.
    """

    def __init__(self, node: Node, policy: Policy) -> None:
        self._node = node
        self._policy = policy
        self._size = policy.networks[0].flat.numel()
        self._held = [-1, -1]
        self._told = [-1, -1]
        self._overdue: float | None = None
        self._keys = [node.key("weights", "1"), node.key("weights", "2")]
        self._weights = [node.latest(key) for key in self._keys]
        self._role = node.latest(node.key("role"))

    @property
    def version(self) -> int:
        """Version of the acting network's parameters."""
        return self._held[self._policy.acting]

    @property
    def ready(self) -> bool:
        """True once both networks are there."""
        return min(self._held) >= 0

    def refresh(self) -> None:
        """Take what was broadcast; ask for what a broadcast should have brought and did not."""
        for follower in self._weights:
            if (message := follower.take()) is not None:
                self._load(message)
        if (message := self._role.take()) is not None:
            self._follow(message)
        if not self.ready:
            self.fetch()
        elif self._held[self._policy.acting] >= self._told[self._policy.acting]:
            self._overdue = None
        else:
            now = time.monotonic()
            self._overdue = self._overdue or now + GRACE
            if now > self._overdue:
                self._overdue = None
                self.fetch()

    def fetch(self) -> None:
        """Ask the learner for both networks and the role; nothing changes if it does not answer."""
        question = messages.encode_question(self._node.run, "current")
        try:
            for key in self._keys:
                self._load(self._node.ask(key, question, timeout=2.0))
            self._follow(self._node.ask(self._node.key("role"), question, timeout=2.0))
        except NoAnswer:
            return

    def _load(self, message: Message) -> None:
        try:
            number, version, flat = messages.decode_weights(message, self._size)
        except BadMessage:
            self._node.count_bad()
            return
        self._policy.networks[number - 1].load(flat)
        self._held[number - 1] = version

    def _follow(self, message: Message) -> None:
        try:
            role = messages.decode_role(message)
        except BadMessage:
            self._node.count_bad()
            return
        self._told = list(role.versions)
        self._policy.acting = role.acting - 1
