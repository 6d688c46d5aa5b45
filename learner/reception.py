"""The learner's answer to those who want to join: the whole run in one message."""

from __future__ import annotations

from functools import partial

from common import messages
from common.config import RunConfig
from common.errors import BadMessage
from common.joining import join_key
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
        self._indices: dict[str, dict[int, int]] = {"replay": {}, "actor": {}}
        for role in self._indices:  # each answered by a thread of its own
            node.serve(join_key(node, role), partial(self._answer, role))

    def _answer(self, role: str, message: Message) -> bytearray:
        request = messages.decode_join(message)
        if request.role != role:
            raise BadMessage("fields.role", f"{request.role!r}; this key is for {role!r}")
        if role == "replay":
            self._replay_endpoints = request.endpoints
        index = self._indices[role].setdefault(request.incarnation, len(self._indices[role]))
        joined = Joined(self._config, self._spec, self._layout, index, self._replay_endpoints)
        return messages.encode_joined(joined)
