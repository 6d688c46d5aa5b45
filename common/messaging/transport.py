"""The transport over Zenoh: one session per process, queries with answers, and puts of which the latest value wins.

A `Node` is one process's place in a run. Data that must not be lost goes as queries (`ask`, `begin`), which a `serve`
loop answers in its own thread; weights, role and status are `publish`ed and read as `latest`.
"""

from __future__ import annotations

import contextlib
import queue
import secrets
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from types import TracebackType
from typing import Any, Self, TypeAlias

import zenoh

from coop.common.bounds import MAX_PAYLOAD, MAX_QUESTION
from coop.common.errors import BadMessage, CoopError, RunError
from coop.common.messaging import wire
from coop.common.messaging.backlog import QUEUE, Backlog, relieve
from coop.common.messaging.conversation import Conversation, Task, drive_held, start
from coop.common.messaging.faults import Faults
from coop.common.messaging.keys import run_key, stop_key
from coop.common.messaging.links import close
from coop.common.messaging.messages.answers import Error
from coop.common.messaging.messages.control import EndOfRun
from coop.common.messaging.messages.status import Status
from coop.common.messaging.presence import Presence
from coop.common.messaging.runs import check_run, identified, name_of
from coop.common.messaging.timing import ASK_TIMEOUT
from coop.common.messaging.wire import Message
from coop.common.process.console import say, stamped
from coop.common.process.lifecycle import Stop

MOST_REFUSALS = 8  # lines that say what is wrong with messages of one key
LONGEST_REFUSAL = 200  # characters


_Waiting: TypeAlias = "queue.SimpleQueue[tuple[Any, bytearray] | None]"
"""Queries and their replies, which wait for a flush; None: there will be no more."""


class NoAnswer(RunError):
    """No process answered a query in time; the caller decides whether to ask again."""


class Unreadable(NoAnswer):
    """What answered speaks another language: a program that is none of this run's."""


class Refused(RunError):
    """The peer rejected the message as invalid or could not fulfil the request, and gave the reason."""


def new_incarnation() -> int:
    """Draw a random id of 63 bits for a process."""
    return secrets.randbits(63)


class Pending:
    """A query in flight: an `Answer`.

    Args:
        handler: Zenoh's, of replies.
        run: of the process that asks, as its messages name it; an answer of another one is none.
    """

    def __init__(self, handler: Any, key: str, run: str) -> None:  # noqa: ANN401
        self._handler = handler
        self._key = key
        self._run = run
        self._reply: zenoh.Reply | None = None
        self._lost = False

    def settled(self) -> bool:
        """Whether the answer has arrived, or can't any more."""
        self._receive(self._handler.try_recv)
        return self._lost or self._reply is not None

    def settle(self) -> None:
        """Wait until it is settled."""
        self._receive(self._handler.recv)

    def ready(self) -> Message | None:
        """The answer if it has arrived, else None.

        Raises:
            NoAnswer: no process serves this key, or the time-out passed.
            Refused: the peer rejected the message as invalid, or could not fulfil the request.
        """
        if not self.settled():
            return None
        if self._reply is None:
            raise NoAnswer(f"no answer to {self._key}")
        return _answer(self._reply, self._run)

    def wait(self) -> Message:
        """Wait for the answer; raises as `ready`."""
        self.settle()
        message = self.ready()
        assert message is not None
        return message

    def _receive(self, receive: Callable[[], zenoh.Reply | None]) -> None:
        if self._reply is None and not self._lost:
            try:
                self._reply = receive()
            except zenoh.ZError:
                self._lost = True


class Node:
    """One process's place in a run.

    Args:
        run: name of the run, the prefix of every key; with its id, if that is known.
        role: "learner", "replay", "actor" or "watch".
        incarnation: the random id drawn at start.

    Attributes:
        run: what messages say of their run: its name, and its id once that is known, see `belong`. run_name: its name.
        presence: the run's other connected members.
        faults: bugs of this program in this node's threads.
    """

    def __init__(self, session: zenoh.Session, run: str, role: str, incarnation: int) -> None:
        self.session = session
        self.run = run
        self.run_name = name_of(run)
        self.incarnation = incarnation
        self.bad_messages = 0
        self.faults = Faults()
        self._counting = threading.Lock()
        self._refusals: dict[str, set[str]] = {}  # fields named in lines so far, by key
        self._name = f"{role}/{incarnation:x}"
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        self._backlogs: list[Backlog] = []
        self._status = session.declare_publisher(self.key("metrics", self._name))
        self.presence = Presence()
        self.presence.watch(session, self.key("alive"), self.faults, self.count_bad)
        self._token = session.liveliness().declare_token(self.key("alive", self._name))

    def key(self, *parts: str) -> str:
        """A key of this run."""
        return run_key(self.run_name, *parts)

    def belong(self, run_id: int) -> None:
        """Take part in this one of the runs of the name; from now on others' messages are refused."""
        self.run = identified(self.run_name, run_id)

    def begin(self, key: str, payload: bytearray, timeout: float = ASK_TIMEOUT) -> Pending:
        """Send a query and return at once."""
        handler = self.session.get(
            key,
            handler=zenoh.handlers.FifoChannel(2),
            payload=payload,
            timeout=timeout,
            congestion_control=zenoh.CongestionControl.BLOCK,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        return Pending(handler, key, self.run)

    def now(self) -> float:
        """Seconds of this process's clock, which never goes back."""
        return time.monotonic()

    def start(self, name: str, conversation: Conversation[None], stop: Stop | None = None) -> Task:
        """Run a conversation beside its caller, see `conversation.start`."""
        return start(name, conversation, stop)

    def pool(self, name: str) -> Executor:
        """One thread, for what takes long and happens in order."""
        return ThreadPoolExecutor(1, name)

    def ask(self, key: str, payload: bytearray, timeout: float = ASK_TIMEOUT) -> Message:
        """Send a query and wait for its answer; raises as `Pending.wait`."""
        return self.begin(key, payload, timeout).wait()

    def serve(
        self,
        key: str,
        answer: Callable[[Message], bytearray | Conversation[bytearray]],
        flush: Callable[[], bytearray | None] | None = None,
        changed: threading.Condition | None = None,
        most: int = MAX_QUESTION,
    ) -> None:
        """Answer the queries on `key`, one after another, in a new thread, until the session closes.

        flush: called in another thread before replies leave, once for all that wait then; returns what leaves in place
            of each, or None if they may leave.
        changed: answers are conversations, which wait for changes of what this guards, and hold it otherwise.
        most: bytes of a message.

        A message that is too long, cannot be decoded, names another run, or makes `answer` raise BadMessage gets an
        error reply, is counted, and changes nothing. Any other CoopError of `answer` also becomes an error reply, and
        so does any other exception, which is a bug and is noted in `faults`. Of the messages that wait, those that
        would be too many, or take too much memory, are counted too and get no reply, see `Backlog`.
        """
        queryable = self.session.declare_queryable(key, zenoh.handlers.FifoChannel(QUEUE), complete=True)
        waiting: _Waiting | None = None
        if flush is not None:
            waiting = queue.SimpleQueue()
            self._start(f"flush {key}", self._reply_flushed, waiting, key, flush)

        def answered(message: Message) -> bytearray:
            given = answer(message)
            if isinstance(given, bytearray):
                return given
            assert changed is not None
            return drive_held(given, changed)

        if not self._backlogs:
            self._start("relieve", relieve, self._backlogs, self._closing)
        self._backlogs.append(backlog := Backlog(queryable, partial(self.count_bad, key)))
        self._start(f"serve {key}", self._serve, backlog, key, answered, waiting, most)

    def _start(self, name: str, target: Callable[..., None], *args: Any) -> None:  # noqa: ANN401
        thread = threading.Thread(target=target, args=args, name=name, daemon=True)
        thread.start()
        self._threads.append(thread)  # only then: `close` waits for them

    def _serve(
        self,
        backlog: Backlog,
        key: str,
        answer: Callable[[Message], bytearray],
        waiting: _Waiting | None,
        most: int,
    ) -> None:
        while not self._closing.is_set():
            try:
                query = backlog.next()
            except zenoh.ZError:  # the session was closed
                break
            try:
                answered = answer(self.read(query.payload, most))
            except Exception as error:
                if isinstance(error, BadMessage):
                    self.count_bad(key, error)
                elif not isinstance(error, CoopError):
                    self.faults.note(f"serving {key}", error)
                with query, contextlib.suppress(zenoh.ZError):
                    query.reply_err(Error.of(error).encode(self.run))
            else:
                if waiting is None:
                    _reply(key, query, answered)
                else:
                    waiting.put((query, answered))
        if waiting is not None:
            waiting.put(None)

    def _reply_flushed(self, waiting: _Waiting, key: str, flush: Callable[[], bytearray | None]) -> None:
        """Send replies once `flush` has returned that was called after they were made, or what it returns."""
        while (first := waiting.get()) is not None:
            group = [first]
            while not waiting.empty() and (another := waiting.get()) is not None:
                group.append(another)
            instead = flush()
            for query, answered in group:
                _reply(key, query, answered if instead is None else instead)

    def read(self, payload: zenoh.ZBytes | None, most: int = MAX_PAYLOAD) -> Message:
        """Decode a payload of this run, of at most so many bytes; raises BadMessage."""
        if payload is not None and len(payload) > most:  # it is not copied, so any number of them costs nothing
            raise BadMessage("payload", f"{len(payload)} bytes; allowed here: at most {most}")
        return check_run(wire.decode(b"" if payload is None else payload.to_bytes()), self.run)

    def count_bad(self, place: str, error: BadMessage) -> None:
        """Count a refused message, and say what is wrong with it, for each field once at each place; thread-safe.

        place: the key that it came by.
        """
        with self._counting:
            self.bad_messages += 1
            reported = self._refusals.setdefault(place, set())
            if error.field in reported or len(reported) >= MOST_REFUSALS:
                return
            reported.add(error.field)
            last = "; further ones are only counted" if len(reported) == MOST_REFUSALS else ""
        say(stamped(f"refused a message at {place}: {str(error)[:LONGEST_REFUSAL]}{last}"))

    def publish(self, key: str, payload: bytearray) -> None:
        """Broadcast a value of which only the latest matters; never blocks."""
        self.session.put(key, payload, congestion_control=zenoh.CongestionControl.DROP)

    def announce(self, key: str, payload: bytearray) -> None:
        """Broadcast a value that should reach all subscribers; may block for a moment."""
        self.session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def publish_status(self, status: Status) -> None:
        """Publish this process's status for displays."""
        with contextlib.suppress(zenoh.ZError):  # the session is being closed, as other threads publish theirs too
            self._status.put(status.encode(self.run))

    def latest(self, key: str) -> Latest:
        """Subscribe to a key of which only the latest value matters."""
        return Latest(self, self.session.declare_subscriber(key, zenoh.handlers.RingChannel(1)))

    def follow_stop(self, stop: Stop) -> None:
        """Set `stop` when the learner ends the run."""

        def stopped(_: str, message: Message) -> None:
            stop.set(EndOfRun.decode(message).reason)

        self.on(stop_key(self), "reading the stop", stopped)

    def on(self, key: str, doing: str, call: Callable[[str, Message], None]) -> None:
        """Call `call(key, message)`, in one of Zenoh's threads, for each value of a key; one that raises is refused."""

        def received(sample: zenoh.Sample) -> None:
            try:
                call(str(sample.key_expr), self.read(sample.payload, MAX_QUESTION))
            except BadMessage as error:
                self.count_bad(key, error)

        self.session.declare_subscriber(key, self.faults.guarded(doing, received))

    def close(self) -> None:
        """Close the session and wait for the serving threads."""
        self._closing.set()
        close(self.session)
        for thread in self._threads:
            thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Latest:
    """The newest value of a broadcast key."""

    def __init__(self, node: Node, subscriber: Any) -> None:  # noqa: ANN401 (zenoh's subscriber)
        self._node = node
        self._subscriber = subscriber

    def poll(self) -> Message | None:
        """The newest value not yet taken; None if there is none or it is not a valid message."""
        sample = self._subscriber.try_recv()
        if sample is None:
            return None
        try:
            return self._node.read(sample.payload)
        except BadMessage as error:
            self._node.count_bad(str(sample.key_expr), error)
            return None


def _reply(key: str, query: Any, answered: bytearray) -> None:  # noqa: ANN401 (zenoh's query)
    with query, contextlib.suppress(zenoh.ZError):  # the asker may be gone; otherwise it asks again
        query.reply(key, answered)


def _answer(reply: zenoh.Reply, run: str) -> Message:
    part = reply.ok or reply.err
    assert part is not None
    raw = part.payload.to_bytes()
    try:
        message = wire.decode(raw)
        if reply.ok is not None:
            return check_run(message, run)
        problem = Error.decode(message).problem
    except BadMessage as error:
        if error.field == "protocol":  # asking again would not help
            raise Refused(str(error)) from error
        if reply.ok is not None:
            raise Unreadable(f"an answer that can't be read: {error}") from error
        raise NoAnswer(raw.decode(errors="replace")) from error
    raise Refused(problem)
