"""The learner's answer to those who want to join: the whole run in one message."""

from __future__ import annotations

from collections import Counter

from common import messages
from common.config import RunConfig
from common.messages import Joined
from common.transport import Node
from common.types import EnvSpec
from common.wire import Message


class Reception:
    """Answers join requests and remembers where the replay service listens."""

    def __init__(self, node: Node, config: RunConfig, spec: EnvSpec, layout: str) -> None:
        self._config = config
        self._spec = spec
        self._layout = layout
        self._replay_endpoints: list[str] = []
        self._indices: dict[int, int] = {}
        self._joined: Counter[str] = Counter()
        node.serve(node.key("config"), self._answer)

    def _answer(self, message: Message) -> bytearray:
        request = messages.decode_join(message)
        if request.role == "replay":
            self._replay_endpoints = request.endpoints
        if request.incarnation not in self._indices:
            self._indices[request.incarnation] = self._joined[request.role]
            self._joined[request.role] += 1
        index = self._indices[request.incarnation]
        return messages.encode_joined(Joined(self._config, self._spec, self._layout, index, self._replay_endpoints))
