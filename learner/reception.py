"""The learner's answer to those who want to join: the whole run in one message."""

from __future__ import annotations

import time
from functools import partial

from common.errors import BadMessage
from common.messaging.keys import join_key
from common.messaging.messages.answers import Retry
from common.messaging.messages.join import Join, Joined
from common.messaging.presence import Origin
from common.messaging.transport import Node
from common.messaging.wire import Message
from common.settings.config import RunConfig
from common.types import EnvSpec
from learner.roster import Occupied, Roster
from learner.shared_epochs import SharedEpochs


class Reception:
    """Answers join requests and remembers where the replay service listens.

    Args:
        epochs: tell which epoch the run goes on from.
    """

    def __init__(
        self,
        node: Node,
        config: RunConfig,
        spec: EnvSpec,
        layout: str,
        run_id: int,
        epochs: SharedEpochs,
        roster: Roster,
    ) -> None:
        self._node = node
        self._config = config
        self._spec = spec
        self._layout = layout
        self._run_id = run_id
        self._epochs = epochs
        self._roster = roster
        self._replay_endpoints: list[str] = []
        self._replay: Origin | None = None
        for role in ("replay", "actor"):  # each answered by a thread of its own
            node.serve(join_key(node, role), partial(self._answer, role))

    def _answer(self, role: str, message: Message) -> bytearray:
        request = Join.decode(message)
        if request.role != role:
            raise BadMessage("fields.role", f"{request.role!r}; this key is for {role!r}")
        epoch, anew, index = self._epochs.newest, False, 0
        try:
            if role == "actor":
                index = self._roster.actor(request)
            elif request.endpoints:  # one without them only asks which run this is
                index = self._admit(request)
                epoch, anew = self._epochs.offered(request)
        except Occupied as other:
            return Retry(str(other)).encode(self._node.run)
        joined = Joined(
            self._config,
            self._spec,
            self._layout,
            index,
            self._replay_endpoints,
            self._run_id,
            epoch,
            anew,
            replay=self._replay,
        )
        return joined.answer()

    def _admit(self, request: Join) -> int:
        """The number of the replay service that serves, and to which actors are sent; raises as `Roster`."""
        there = {int(incarnation, 16) for incarnation in self._node.presence.members("replay")}
        index = self._roster.replay(request, time.monotonic(), there)
        self._replay_endpoints, self._replay = request.endpoints, request.origin
        return index
