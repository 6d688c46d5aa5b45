"""A simulated process's place in a run, in place of a `Node` over Zenoh: questions with answers, and broadcasts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from fnmatch import fnmatchcase
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from benchmarks.simulate.network import Link, Network
from benchmarks.simulate.server import Server
from benchmarks.simulate.world import Activity, Process, Violation
from coop.common.bounds import MAX_QUESTION
from coop.common.errors import BadMessage
from coop.common.messaging import wire
from coop.common.messaging.conversation import Conversation
from coop.common.messaging.keys import run_key, stop_key
from coop.common.messaging.messages.answers import Error
from coop.common.messaging.messages.control import EndOfRun
from coop.common.messaging.presence import Presence
from coop.common.messaging.runs import check_run, identified, name_of
from coop.common.messaging.timing import ASK_TIMEOUT, LEASE
from coop.common.messaging.transport import NoAnswer, Refused
from coop.common.messaging.wire import Message
from coop.common.process.lifecycle import Stop

RUN = "run"
_fits = lru_cache(1024)(fnmatchcase)


class SimAnswer:
    """The answer to a question: an `Answer`."""

    def __init__(self, node: SimNode, key: str, timeout: float) -> None:
        self.node = node
        self.key = key
        self._run = node.run
        self._raw: bytes | None = None
        self._settled = False
        self._then: Callable[[], None] | None = None
        node.network.world.after(timeout, self.lose)

    def then(self, call: Callable[[], None]) -> None:
        """Call `call` once it is settled."""
        if self._settled:
            self.node.network.world.after(0.0, call)
        else:
            self._then = call

    def settled(self) -> bool:
        """See `Answer`."""
        return self._settled

    def settle(self) -> None:
        """A simulated process never blocks."""
        raise AssertionError(self.key)

    def lose(self) -> None:
        """No answer can come any more."""
        self._end(None)

    def give(self, raw: bytes) -> None:
        """The answer has arrived."""
        self._end(raw)

    def _end(self, raw: bytes | None) -> None:
        if self._settled:
            return
        self._settled, self._raw = True, raw
        if raw is not None:
            self.node.arrived(self.key, raw)
        if self._then is not None:
            call, self._then = self._then, None
            self.node.process.do(call)

    def ready(self) -> Message | None:
        """See `Answer`."""
        if not self._settled:
            return None
        if self._raw is None:
            raise NoAnswer(f"no answer to {self.key}")
        message = wire.decode(self._raw)
        if message.kind == Error.kind:
            raise Refused(Error.decode(message).problem)
        try:
            return check_run(message, self._run)
        except BadMessage as error:
            raise NoAnswer(f"an answer that can't be read: {error}") from error


class SimLatest:
    """The newest value of a broadcast key."""

    def __init__(self, node: SimNode, key: str) -> None:
        self._node = node
        self._key = key
        self.raw: bytes | None = None

    def poll(self) -> Message | None:
        """See `Latest`."""
        raw, self.raw = self.raw, None
        try:
            return None if raw is None else self._node.read(raw)
        except BadMessage as error:
            self._node.count_bad(self._key, error)
            return None


class _Inline(Executor):
    """Does at once what a thread would do."""

    def submit(self, call: Any, /, *args: Any, **named: Any) -> Future[Any]:  # noqa: ANN401
        """See `Executor`."""
        future: Future[Any] = Future()
        future.set_result(call(*args, **named))
        return future


class _Loud:
    """Bugs in the product's own threads are violations here."""

    count = 0

    def note(self, place: str, error: Exception) -> None:
        """See `Faults`."""
        raise Violation(f"a bug, {place}: {error!r}") from error


class SimNode:
    """One process's place in a run: a `Node`.

    Attributes:
        on_reply: called with the node, the key, the question and the answer whenever one leaves.
        on_heard: called with the node, the one that has broadcast, and the key, whenever that was obeyed.
    """

    on_reply: Callable[[SimNode, str, Message, bytes], None] = staticmethod(lambda node, key, message, reply: None)
    on_heard: Callable[[SimNode, SimNode, str], None] = staticmethod(lambda node, source, key: None)

    def __init__(
        self,
        network: Network,
        process: Process,
        role: str,
        incarnation: int,
        listen: str = "",
        connect: Sequence[str] = (),
        run: str = RUN,
    ) -> None:
        self.network = network
        self.process = process
        self.run = run
        self.run_name = name_of(run)
        self.role = role
        self.incarnation = incarnation
        self.bad_messages = 0
        self.faults = _Loud()
        self.presence = Presence(process.now)
        self.links: list[Link] = []
        self.open = True
        self.session = SimpleNamespace(liveliness=lambda: SimpleNamespace(get=lambda key, timeout: ()))
        self._servers: dict[str, Server] = {}
        self._latest: dict[str, SimLatest] = {}
        self._calls: list[tuple[str, Callable[[str, Message], None]]] = []
        process.nodes.append(self)
        if listen:
            network.listening[listen] = self
        for endpoint in connect:
            network.connect(self, endpoint)

    def key(self, *parts: str) -> str:
        """See `Node`."""
        return run_key(self.run_name, *parts)

    def belong(self, run_id: int) -> None:
        """See `Node`."""
        self.run = identified(self.run_name, run_id)
        self.process.state["run"] = run_id

    def now(self) -> float:
        """See `Node`."""
        return self.process.now()

    def start(self, name: str, conversation: Conversation[None], stop: Stop | None = None) -> Activity:
        """See `Node`."""
        return self.process.start(name, conversation, stop)

    def pool(self, name: str) -> Executor:
        """See `Node`."""
        return _Inline()

    def read(self, payload: bytes) -> Message:
        """See `Node`."""
        return check_run(wire.decode(payload), self.run)

    def count_bad(self, place: str, error: BadMessage) -> None:
        """Nobody sends bad messages here, but another run of the same name its own."""
        if error.field != "run":
            raise Violation(f"a bad message at {place}: {error}")
        self.bad_messages += 1

    def linked(self, other: SimNode) -> bool:
        """Whether there is a link."""
        return any(link.other(self) is other for link in self.links)

    def begin(self, key: str, payload: bytearray, timeout: float = ASK_TIMEOUT) -> SimAnswer:
        """See `Node`."""
        answer, raw = SimAnswer(self, key, timeout), bytes(payload)
        for link in self.links:
            server = link.other(self)._servers.get(key)
            if server is not None:
                link.questions = [each for each in link.questions if not each.settled()]
                link.questions.append(answer)
                self.network.send(self, link, lambda s=server, lk=link: s.receive(raw, answer, lk))  # type: ignore[misc]
                return answer
        self.network.world.after(0.001, answer.lose)
        return answer

    def serve(
        self,
        key: str,
        answer: Callable[[Message], bytearray | Conversation[bytearray]],
        flush: Callable[[], bytearray | None] | None = None,
        changed: threading.Condition | None = None,
        most: int = MAX_QUESTION,
    ) -> None:
        """See `Node`; no message here is long."""
        self._servers[key] = Server(self, key, answer, flush)
        if changed is not None:
            changed.notify_all = self._changed  # type: ignore[method-assign]

    def _changed(self) -> None:
        """Let the conversations that wait look again."""
        process = self.process
        for server in self._servers.values():
            if server.held is not None:
                turn = server.turn
                process.world.after(0.0, lambda s=server, n=turn: process.do(lambda: s._timed(n)))  # type: ignore[misc]

    def publish(self, key: str, payload: bytearray) -> None:
        """See `Node`."""
        raw = bytes(payload)
        for link in self.links:
            other = link.other(self)
            if other.wants(key):
                self.network.send(self, link, lambda o=other: o.receive(key, raw, self))  # type: ignore[misc]

    announce = publish

    def wants(self, key: str) -> bool:
        """Whether this node follows a key."""
        return key in self._latest or any(_fits(key, pattern) for pattern, _ in self._calls)

    def receive(self, key: str, raw: bytes, source: SimNode) -> None:
        """Take a broadcast."""
        if not self.open:
            return
        self.arrived(key, raw)
        if key in self._latest:
            self._latest[key].raw = raw
        for pattern, call in self._calls:
            if _fits(key, pattern):
                try:
                    call(key, self.read(raw))
                except BadMessage as error:
                    self.count_bad(key, error)
                else:
                    self.on_heard(self, source, key)

    def arrived(self, key: str, raw: bytes) -> None:
        """Remember what has been said about the acting role."""
        if key.endswith("/role"):
            self.process.state.setdefault("roles", []).append(raw)

    def publish_status(self, status: object) -> None:
        """Nobody looks at displays here."""

    def latest(self, key: str) -> SimLatest:
        """See `Node`."""
        self._latest[key] = SimLatest(self, key)
        return self._latest[key]

    def on(self, key: str, doing: str, call: Callable[[str, Message], None]) -> None:
        """See `Node`."""
        self._calls.append((key, call))

    def follow_stop(self, stop: Stop) -> None:
        """See `Node`."""
        self.on(stop_key(self), "the stop", lambda key, message: stop.set(EndOfRun.decode(message).reason))

    def close(self) -> None:
        """See `Node`."""
        self.open = False
        for link in list(self.links):
            self.network.take_down(link)
        if self in self.process.nodes:
            self.process.nodes.remove(self)

    def gone(self) -> None:
        """Its process has ended: the kernel says so to those whom it reaches; others notice by themselves."""
        self.open = False
        for link in list(self.links):
            other = link.other(self)
            silent = self.network.blocked(self, other) or other.process.frozen
            self.network.world.after(LEASE if silent else 0.002, lambda lk=link: self._lost(lk))  # type: ignore[misc]

    def _lost(self, link: Link) -> None:
        if link.up:
            self.network.take_down(link)
