"""The learner's answers to roles that join or leave."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

from coop.common.errors import BadMessage
from coop.common.messaging.keys import join_key
from coop.common.messaging.members import JOINING, ROLES, Origin
from coop.common.messaging.messages.answers import Retry
from coop.common.messaging.messages.control import Farewell, Join, JoinReply, Leave
from coop.common.messaging.transport import Node
from coop.common.messaging.wire import Message
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import to_tables
from coop.common.types import EnvSpec
from coop.learner.roster import AlreadyServed, MemberTracker, Roster
from coop.learner.shared_checkpoints import SharedCheckpoints


class Departure:
    """The departure of a replay service that stops but stays until its data have been saved; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked: int | None = None
        self._granted: int | None = None
        self._over = False

    @property
    def is_due(self) -> bool:
        """True while a replay service waits for a checkpoint to be saved."""
        with self._lock:
            return self._asked is not None and self._asked != self._granted

    def ask(self, incarnation: int) -> bool:
        """Note that a replay service wants to leave; return True once it may."""
        with self._lock:
            self._asked = incarnation
            return self._over or self._granted == incarnation

    def grant(self) -> None:
        """Permit the replay service that has asked to leave: its data are saved."""
        with self._lock:
            self._granted = self._asked

    def end(self) -> None:
        """Permit every departure from now on: the run is over."""
        with self._lock:
            self._over = True


class JoinService:
    """Answers requests to join or leave, and remembers where the replay service listens.

    Args:
        shared: determine the checkpoint from which the run continues.
        event: called with a line when a member comes or goes.

    Attributes:
        members: the members by name.
        departure: of the replay service, if it wants to leave.
    """

    def __init__(
        self,
        node: Node,
        config: RunConfig,
        spec: EnvSpec,
        layout: str,
        run_id: int,
        shared: SharedCheckpoints,
        roster: Roster,
        event: Callable[[str], None],
    ) -> None:
        self.members = MemberTracker(event)
        self.departure = Departure()
        self._node = node
        self._config = config
        self._tables = to_tables(config)
        self._spec = spec
        self._layout = layout
        self._run_id = run_id
        self._shared = shared
        self._roster = roster
        self._replay_endpoints: list[str] = []
        self._replay: Origin | None = None
        for key in {join_key(node, role) for role in JOINING}:  # each with its own thread
            node.serve(key, partial(self._answer, key))

    @property
    def serving(self) -> int:
        """Incarnation of the active replay service; -1 before the first."""
        return self._roster.serving

    def connected(self) -> dict[str, int]:
        """Number of connected processes by role; a replay service that was not admitted does not count."""
        counts = {**dict.fromkeys(ROLES, 0), **self._node.presence.counts()}
        return {**counts, "replay": int(self._roster.serving in self._there("replay"))}

    def _answer(self, key: str, message: Message) -> bytearray:
        if message.kind == Leave.kind:
            return self._leave(key, Leave.decode(message).incarnation)
        request = Join.decode(message)
        if key != join_key(self._node, request.role):
            raise BadMessage("fields.role", f"{request.role!r} asks at {join_key(self._node, request.role)}")
        checkpoint, anew, index = self._shared.newest, False, 0
        try:
            if request.role == "actor":
                index = self._roster.actor(request)
            elif request.role == "replay" and request.endpoints:  # without endpoints it only asks which run this is
                index = self._admit(request)
                checkpoint, anew = self._shared.offered(request)
        except AlreadyServed as other:
            return Retry(str(other)).encode(self._node.run)
        names = {"actor": f"actor {index}", "evaluator": "evaluator"}
        if request.role in names or request.endpoints:
            self.members.add(request, names.get(request.role, "replay service"))
            if (there := self.members.forget(self._there)) is not None:
                self._roster.forget(there)
        reply = JoinReply(
            self._config,
            self._spec,
            self._layout,
            index,
            self._replay_endpoints,
            self._run_id,
            checkpoint,
            anew,
            replay=self._replay,
        )
        return reply.answer(self._node.run, self._tables)

    def _admit(self, request: Join) -> int:
        """Admit a replay service, and send actors to it; return its number. Raises as `Roster.replay`."""
        index = self._roster.replay(request, self._node.now(), self._there("replay"))
        self._replay_endpoints, self._replay = request.endpoints, request.origin
        return index

    def _there(self, *roles: str) -> set[int]:
        """The incarnations of connected processes, of these roles if any are named."""
        members = self._node.presence.members
        return {int(incarnation, 16) for role in roles or ROLES for incarnation in members(role)}

    def _leave(self, key: str, incarnation: int) -> bytearray:
        if incarnation == self._roster.serving:
            if key != join_key(self._node, "replay"):
                raise BadMessage("fields.incarnation", "not an actor's")
            if not self.departure.ask(incarnation):
                return Retry("a checkpoint must be saved first").encode(self._node.run)
            self._roster.dismiss(incarnation)
        self.members.leaving(incarnation)
        return Farewell().encode(self._node.run)
