"""Queries that wait for an answer, and messages that are too large: neither takes memory, nor keeps others out."""

import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from samples import await_service, make_segment, until

from coop.common.bounds import MAX_QUESTION
from coop.common.errors import BadMessage
from coop.common.messaging import backlog, transport, wire
from coop.common.messaging.messages.answers import Ack
from coop.common.messaging.messages.insert import SegmentReader, encode_segment
from coop.common.messaging.transport import NoAnswer, Node, Pending, Refused
from coop.common.types import EnvSpec

MIB = 1 << 20
LARGE = 4 * MIB


@pytest.fixture
def held(nodes: tuple[Node, Node]) -> Iterator[threading.Event]:
    """What answers wait for; set at the end, as the nodes wait for their threads."""
    event = threading.Event()
    yield event
    event.set()


def resident() -> int:
    """Bytes of this process's memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def test_queries_that_wait_take_bounded_memory(
    nodes: tuple[Node, Node], held: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many arrive while one is being answered; in order, and small ones still find a place."""
    monkeypatch.setattr(backlog, "MOST_WAITING", 8 * MIB)
    learner, actor = nodes
    answered: list[int] = []

    def answer(message: wire.Message) -> bytearray:
        held.wait()
        answered.append(message.fields["inserted"])
        return Ack(message.fields["inserted"]).encode("test")

    key = learner.key("held")
    learner.serve(key, answer, most=2 * LARGE)
    await_service(actor, key)
    padding = {"padding": np.zeros(LARGE, np.uint8)}

    def refused(count: int) -> bool:
        return learner.bad_messages == count

    first = actor.begin(key, Ack(0).encode("test"), 60.0)
    large: list[Pending] = []
    resided = []
    for sent in range(0, 60, 10):  # what arrives at one time is in memory for a moment
        numbers = range(sent + 1, sent + 11)
        large += [actor.begin(key, wire.encode("ack", "test", Ack(n), padding), 60.0) for n in numbers]
        until(partial(refused, len(large) - 1))
        resided.append(resident())
    assert resided[-1] - resided[0] < 100 * MIB, "of 200"
    last = actor.begin(key, Ack(61).encode("test"), 60.0)
    assert not last.settled()
    held.set()
    assert [Ack.decode(each.wait()).inserted for each in (first, last)] == [0, 61]
    for each in large[1:]:
        with pytest.raises(NoAnswer):  # and so they are sent again
            each.wait()
    assert answered == [0, 1, 61]
    assert actor.ask(key, Ack(62).encode("test")).fields["inserted"] == 62


def test_a_queue_that_is_full_keeps_nobody_else_waiting(
    nodes: tuple[Node, Node], held: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (backlog, transport):
        monkeypatch.setattr(module, "QUEUE", 8)
    learner, actor = nodes

    def answer(message: wire.Message) -> bytearray:
        held.wait()
        return Ack(0).encode("test")

    learner.serve(learner.key("held"), answer)
    learner.serve(learner.key("free"), lambda message: Ack(1).encode("test"))
    for key in ("held", "free"):
        await_service(actor, learner.key(key))
    waiting = [actor.begin(learner.key("held"), Ack(0).encode("test"), 60.0) for _ in range(200)]
    assert Ack.decode(actor.ask(learner.key("free"), Ack(0).encode("test"))).inserted == 1
    held.set()
    for each in waiting:
        with suppress(NoAnswer):
            each.wait()


def test_no_message_is_longer_than_its_key_allows(nodes: tuple[Node, Node]) -> None:
    learner, actor = nodes
    key, heard = learner.key("small"), learner.key("told")
    learner.serve(key, lambda message: Ack(0).encode("test"))
    learner.on(heard, "hearing", lambda key, message: None)
    await_service(actor, key)
    long = bytearray(MAX_QUESTION + 1)
    with pytest.raises(Refused, match=rf"payload: {len(long)} bytes; allowed here: at most {MAX_QUESTION}"):
        actor.ask(key, long)
    actor.announce(heard, long)
    until(lambda: learner.bad_messages == 2)


def test_a_message_carries_nothing_but_its_arrays() -> None:
    spec = EnvSpec("toy", (4,), "float32", 1, 2)
    read = SegmentReader(spec)
    message = bytes(encode_segment("run", make_segment(spec)))
    read(wire.decode(message))
    with pytest.raises(BadMessage, match=r"^payload: \d+ bytes; its arrays end after \d+$"):
        wire.decode(message + bytes(wire.ALIGNMENT))
    segment = make_segment(spec, frames=np.zeros((10_000, 4), np.float32))
    with pytest.raises(BadMessage, match=r"^arrays.frames: 10000 frames of 4 steps; at most 408$"):
        read(wire.decode(bytes(encode_segment("run", segment))))
