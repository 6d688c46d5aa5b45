"""Errors of this program in threads: answered, counted, printed once; and a table that they left half changed."""

import threading
from pathlib import Path

import pytest
from samples import await_service, make_segment, until

from coop.common.messaging.conversation import drive
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.answers import Ack, Retry
from coop.common.messaging.messages.control import Snapshot
from coop.common.messaging.messages.insert import encode_segment
from coop.common.messaging.messages.status import ReplayStats, StatsQuestion
from coop.common.messaging.messages.weights import Current
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, Refused, new_incarnation
from coop.common.messaging.wire import Message
from coop.common.process.console import Console
from coop.common.process.lifecycle import Stop
from coop.common.settings.config import RunConfig
from coop.common.types import EnvSpec
from coop.replay.core import ReplayCore
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.service import ReplayService


def test_a_serving_thread_outlives_an_error(nodes: tuple[Node, Node], capfd: pytest.CaptureFixture[str]) -> None:
    server, client = nodes
    broken = [True, True]

    def answer(message: Message) -> bytearray:
        if broken:
            broken.pop()
            raise ZeroDivisionError("of no use to anybody")
        return Ack(1).encode("test")

    server.serve(server.key("role"), answer)
    await_service(client, server.key("role"))
    for _ in range(2):
        with pytest.raises(Refused, match="error of this program: ZeroDivisionError"):
            client.ask(client.key("role"), Current().encode("test"))
    assert Ack.decode(client.ask(client.key("role"), Current().encode("test"))) == Ack(1)
    assert (server.faults.count, server.bad_messages) == (2, 0)
    printed = capfd.readouterr().err
    assert printed.count("Traceback") == 1
    assert "serving coop/test/role" in printed


def test_a_callback_of_zenoh_outlives_an_error(nodes: tuple[Node, Node], endpoint: str) -> None:
    learner, _ = nodes

    def look() -> None:
        raise ZeroDivisionError

    until(lambda: learner.presence.counts().get("actor") == 1)  # the fixture's own, whose coming is no change any more
    learner.presence.on_change(look)
    with Node(open_session((), (endpoint,)), "test", "replay", new_incarnation()):
        until(lambda: learner.faults.count == 1)
        assert learner.presence.counts()["replay"] == 1
    until(lambda: learner.faults.count == 2)


@pytest.mark.parametrize("question", ["insert", "snapshot"])
def test_a_table_that_may_be_half_changed_is_not_used_any_more(
    nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, question: str
) -> None:
    server, client = nodes
    core, stop = ReplayCore(RunConfig(run="test"), spec), Stop()
    service = ReplayService(server, core, ReplayCheckpoints(tmp_path, 5))
    service.start()
    await_service(client, replay_key(client, "snapshot"))  # the last one that it declares
    running = threading.Thread(target=drive, args=(service.serving(stop, Console()), stop))
    running.start()
    first, second = (encode_segment("test", make_segment(spec, number)) for number in range(2))
    client.ask(replay_key(client, "insert"), first)

    def fail(*_: object) -> None:
        raise ZeroDivisionError("half way")

    monkeypatch.setattr(core.table, question, fail)
    payload = second if question == "insert" else Snapshot(1, [], 1, 0).encode("test")
    with pytest.raises(Refused, match="half way"):
        client.ask(replay_key(client, question), payload)
    until(stop.is_set)
    running.join(20)
    assert stop.failed
    assert "may have left the table half changed: ZeroDivisionError" in stop.reason
    monkeypatch.undo()
    assert "half changed" in Retry.decode(client.ask(replay_key(client, "insert"), second)).reason
    with pytest.raises(Refused, match="half changed"):
        client.ask(replay_key(client, "snapshot"), Snapshot(2, [], 1, 1).encode("test"))
    stats = ReplayStats.decode(client.ask(replay_key(client, "stats"), StatsQuestion().encode("test")))
    assert (stats.faults, stats.inserted) == (1, 4)


def test_a_thread_that_ends_of_an_error_ends_the_process(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)  # so that the old one comes back
    stop = Stop()
    stop.on_thread_failures()

    def fail() -> None:
        raise ZeroDivisionError("gone")

    thread = threading.Thread(target=fail, name="checkpoint 7")
    thread.start()
    thread.join()
    assert stop.failed
    assert stop.reason == "error of this program in the thread 'checkpoint 7': ZeroDivisionError: gone"
    assert "Traceback" in capfd.readouterr().err
