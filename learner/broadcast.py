"""Broadcasts the weights and the acting role, and answers queries for them from late joiners."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from functools import partial

import numpy as np
from numpy.typing import NDArray

from coop.common.messaging.keys import role_key, weights_key
from coop.common.messaging.messages.weights import Current, Role, Weights
from coop.common.messaging.transport import Node
from coop.common.messaging.wire import Message
from coop.learner.protocol import AnyAgent

SMALL = 1 << 20  # bytes to all actors together, for which no other thread is woken


class Broadcaster:
    """Publishes an agent's networks and role, and answers queries with the values published last.

    Small networks to few actors are sent at once. Others are sent by a thread, because that takes as long as many
    updates; meanwhile no more are sent, and the newest ones follow.

    env_step: environment steps of the run so far, here and below.

    Attributes:
        due: what was to be published has had to wait; call `publish` again.
    """

    def __init__(self, node: Node, agent: AnyAgent, env_step: int = 0) -> None:
        self.due = False
        self._node = node
        self._agent = agent
        self._taken = [-1, -1]  # versions handed to the thread
        self._published = [-1, -1]
        self._progress = (0, 0)
        self._acting = 0
        self._weights = [bytearray(), bytearray()]
        self._role = bytearray()
        self._thread = node.pool("broadcast")
        self._sent: Future[None] | None = None
        self.publish(env_step, wait=True)
        node.serve(self._weights_key(0), lambda message: self._answer(message, self._weights[0]))
        node.serve(self._weights_key(1), lambda message: self._answer(message, self._weights[1]))
        node.serve(role_key(node), lambda message: self._answer(message, self._role))

    def publish(self, env_step: int = 0, *, wait: bool = False) -> None:
        """Broadcast the networks that changed since their last broadcast, then the role.

        wait: until all has been sent. Raises what an earlier broadcast met.
        """
        if self._sending() and not wait:
            self.due = True
            return
        self._await()
        self.due = False
        agent, changed = self._agent, []
        for number, version in enumerate(agent.versions):
            if version != self._taken[number]:
                changed.append((number, version, agent.networks[number].snapshot()))
                self._taken[number] = version
        send = partial(self._send, changed, agent.acting, (agent.updates, env_step))
        actors = self._node.presence.counts().get("actor", 0)
        if wait or actors * sum(flat.nbytes for _, _, flat in changed) < SMALL:
            send()
        else:
            self._sent = self._thread.submit(send)

    def publish_role(self) -> None:
        """Repeat the role of the last broadcast, unless a new one is on its way."""
        if not self._sending():
            self._publish_role()

    def close(self) -> None:
        """Wait for the thread."""
        self._thread.shutdown()

    def _sending(self) -> bool:
        return self._sent is not None and not self._sent.done()

    def _await(self) -> None:
        if self._sent is not None:
            self._sent.result()

    def _send(
        self, changed: Sequence[tuple[int, int, NDArray[np.float32]]], acting: int, progress: tuple[int, int]
    ) -> None:
        """Broadcast networks, (number, version, parameters) each, and the role with the versions published last."""
        node = self._node
        for number, version, flat in changed:
            self._weights[number] = Weights(number + 1, version, flat).encode(node.run)
            self._published[number] = version
            node.publish(self._weights_key(number), self._weights[number])
        self._acting, self._progress = acting, progress
        self._publish_role()

    def _publish_role(self) -> None:
        role = Role(self._acting + 1, (self._published[0], self._published[1]), *self._progress)
        self._role = role.encode(self._node.run)
        self._node.publish(role_key(self._node), self._role)

    def _weights_key(self, number: int) -> str:
        return weights_key(self._node, number + 1)

    def _answer(self, message: Message, payload: bytearray) -> bytearray:
        Current.decode(message)
        return payload
