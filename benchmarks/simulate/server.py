"""A simulated process's answers to questions: one after another, some of them only once a journal is flushed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from benchmarks.simulate.network import Link
from coop.common.errors import CoopError
from coop.common.messaging.conversation import Conversation
from coop.common.messaging.messages.answers import Error
from coop.common.messaging.wire import Message

if TYPE_CHECKING:
    from benchmarks.simulate.node import SimAnswer, SimNode


class Server:
    """Answers the questions of one key, one after another."""

    def __init__(
        self,
        node: SimNode,
        key: str,
        answer: Callable[[Message], bytearray | Conversation[bytearray]],
        flush: Callable[[], bytearray | None] | None,
    ) -> None:
        self.node, self.key, self.answer, self.flush = node, key, answer, flush
        self.queue: deque[tuple[bytes, SimAnswer, Link]] = deque()
        self.held: Conversation[bytearray] | None = None
        self.current: Message | None = None
        self.turn = 0
        self._unflushed: list[tuple[bytes, SimAnswer, Link, Message]] = []

    def receive(self, raw: bytes, answer: SimAnswer, link: Link) -> None:
        """Take a question."""
        self.queue.append((raw, answer, link))
        if self.held is None and len(self.queue) == 1:
            self._next()

    def _next(self) -> None:
        while self.queue and self.held is None:
            raw, answer, link = self.queue[0]
            try:
                self.current = self.node.read(raw)
                given = self.answer(self.current)
            except Exception as error:  # as in `Node._serve`
                self._refuse(error, answer, link)
                continue
            if isinstance(given, bytearray):
                self._reply(given)
            else:
                self.held = given
                self.go_on()
                return

    def go_on(self) -> None:
        """Resume the conversation that answers."""
        if self.held is None:
            return
        self.turn += 1
        try:
            wait = next(self.held)
        except StopIteration as end:
            self.held = None
            self._reply(end.value)
        except Exception as error:
            self.held = None
            _, answer, link = self.queue[0]
            self._refuse(error, answer, link)
        else:
            assert isinstance(wait, float | int)
            turn, process = self.turn, self.node.process
            process.world.after(wait, lambda: process.do(lambda: self._timed(turn)))
            return
        self._next()

    def _timed(self, turn: int) -> None:
        if turn == self.turn:
            self.go_on()

    def _refuse(self, error: Exception, answer: SimAnswer, link: Link) -> None:
        if not isinstance(error, CoopError):
            self.node.faults.note(f"serving {self.key}", error)
        self.queue.popleft()
        self._send(bytes(Error.of(error).encode(self.node.run)), answer, link)

    def _reply(self, payload: bytearray) -> None:
        _, answer, link = self.queue.popleft()
        assert self.current is not None
        reply = bytes(payload)
        if self.flush is None:
            self._give(reply, answer, link, self.current)
            return
        self._unflushed.append((reply, answer, link, self.current))
        if len(self._unflushed) == 1:
            process = self.node.process
            process.world.after(process.world.disk_delay(process), lambda: process.do(self._flush))

    def _flush(self) -> None:
        group, self._unflushed = self._unflushed, []
        assert self.flush is not None
        instead = self.flush()
        for reply, answer, link, message in group:
            self._give(reply if instead is None else bytes(instead), answer, link, message)

    def _give(self, reply: bytes, answer: SimAnswer, link: Link, message: Message) -> None:
        self.node.on_reply(self.node, self.key, message, reply)
        self._send(reply, answer, link)

    def _send(self, reply: bytes, answer: SimAnswer, link: Link) -> None:
        if link.up:
            self.node.network.send(self.node, link, lambda: answer.give(reply))
