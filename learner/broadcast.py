"""Broadcasts the weights and the acting role, and answers queries for them from late joiners."""

from __future__ import annotations

from coop.common.messaging.keys import role_key, weights_key
from coop.common.messaging.messages.weights import Current, Role, Weights
from coop.common.messaging.transport import Node
from coop.common.messaging.wire import Message
from coop.learner.protocol import AnyAgent


class Broadcaster:
    """Publishes an agent's networks and role, and answers queries with the values published last.

    env_step: environment steps of the run so far, here and below.
    """

    def __init__(self, node: Node, agent: AnyAgent, env_step: int = 0) -> None:
        self._node = node
        self._agent = agent
        self._progress = (0, 0)
        self._published = [-1, -1]
        self._weights = [bytearray(), bytearray()]
        self._role = bytearray()
        self.publish(env_step)
        node.serve(self._weights_key(0), lambda message: self._answer(message, self._weights[0]))
        node.serve(self._weights_key(1), lambda message: self._answer(message, self._weights[1]))
        node.serve(role_key(node), lambda message: self._answer(message, self._role))

    def publish(self, env_step: int = 0) -> None:
        """Broadcast the networks that changed since their last broadcast, then the role."""
        agent, node = self._agent, self._node
        for number, version in enumerate(agent.versions):
            if version != self._published[number]:
                flat = agent.networks[number].snapshot()
                self._weights[number] = Weights(number + 1, version, flat).encode(node.run)
                self._published[number] = version
                node.publish(self._weights_key(number), self._weights[number])
        self._progress = (agent.updates, env_step)
        self.publish_role()

    def publish_role(self) -> None:
        """Broadcast the acting role with the versions of the networks as published last."""
        agent, node = self._agent, self._node
        role = Role(agent.acting + 1, (self._published[0], self._published[1]), *self._progress)
        self._role = role.encode(node.run)
        node.publish(role_key(node), self._role)

    def _weights_key(self, number: int) -> str:
        return weights_key(self._node, number + 1)

    def _answer(self, message: Message, payload: bytearray) -> bytearray:
        Current.decode(message)
        return payload
