"""The learner's answer to those who want to join: the whole run in one message."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from common.errors import BadMessage
from common.messaging import messages
from common.messaging.joining import join_key
from common.messaging.messages import Joined
from common.messaging.presence import Origin
from common.messaging.transport import Node
from common.messaging.wire import Message
from common.settings.config import RunConfig
from common.types import EnvSpec


class Reception:
    """Answers join requests and remembers where the replay service listens.

    Args:
        newest_epoch: gives the number of the newest epoch that is finished.
    """

    def __init__(
        self, node: Node, config: RunConfig, spec: EnvSpec, layout: str, run_id: int, newest_epoch: Callable[[], int]
    ) -> None:
        self._config = config
        self._spec = spec
        self._layout = layout
        self._run_id = run_id
        self._newest_epoch = newest_epoch
        self._replay_endpoints: list[str] = []
        self._replay: Origin | None = None
        self._indices: dict[str, dict[int, int]] = {"replay": {}, "actor": {}}
        for role in self._indices:  # each answered by a thread of its own
            node.serve(join_key(node, role), partial(self._answer, role))

    def _answer(self, role: str, message: Message) -> bytearray:
        request = messages.decode_join(message)
        if request.role != role:
            raise BadMessage("fields.role", f"{request.role!r}; this key is for {role!r}")
        if role == "replay":
            self._replay_endpoints, self._replay = request.endpoints, request.origin
        indices = self._indices[role]
        if request.incarnation not in indices:
            indices[request.incarnation] = max(indices.values(), default=-1) + 1 if request.index < 0 else request.index
        joined = Joined(
            self._config,
            self._spec,
            self._layout,
            indices[request.incarnation],
            self._replay_endpoints,
            self._run_id,
            self._newest_epoch(),
            replay=self._replay,
        )
        return messages.encode_joined(joined)
