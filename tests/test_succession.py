"""One replay service serves a run; whoever takes over from it is found by all, wherever it listens."""

import json
import re
import signal
import socket
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import zenoh
from commands import Command, lines, wait_for
from samples import await_service, make_segment

from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.keys import replay_key, status_key
from coop.common.messaging.messages.answers import Ack, Retry
from coop.common.messaging.messages.insert import encode_segment
from coop.common.messaging.messages.sample import encode_request
from coop.common.messaging.messages.status import LearnerStatus
from coop.common.messaging.route import ReplayRoute
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.lifecycle import Stop
from coop.common.process.processes import free_endpoint
from coop.common.settings.config import RunConfig
from coop.common.transitions import DrawRequest
from coop.common.types import EnvSpec
from coop.records.learner_checkpoints import newest_checkpoint
from coop.replay.core import ReplayCore
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.service import ReplayService

pytestmark = pytest.mark.timeout(300)  # processes that start one after the other, also on a busy machine


def test_a_service_that_is_not_confirmed_neither_acknowledges_nor_draws(
    nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path
) -> None:
    server, client = nodes
    core = ReplayCore(RunConfig(run="test"), spec)
    service = ReplayService(server, core, ReplayCheckpoints(tmp_path, 5), confirmed=0.0)
    service.start()
    await_service(client, replay_key(client, "snapshot"))  # the last one that it declares
    segment = encode_segment("test", make_segment(spec))
    draw = encode_request("test", DrawRequest(1, 0, 0, core.batch_size, 0))
    for question, payload in (("insert", segment), ("sample", draw)):
        answer = client.ask(replay_key(client, question), payload)
        assert Retry.decode(answer).reason == "the learner has not confirmed this replay service lately"
    assert core.table.inserted == 0
    service.confirm(time.monotonic() + 60)
    assert Ack.decode(client.ask(replay_key(client, "insert"), segment)).inserted == 4
    service.confirm(time.monotonic() - 1)  # as after a freeze
    payload = encode_segment("test", make_segment(spec, 1))
    assert client.ask(replay_key(client, "insert"), payload).kind == "retry"
    assert core.table.inserted == 4


def test_a_route_follows_a_replay_service_to_another_address(spec: EnvSpec, tmp_path: Path) -> None:
    core = ReplayCore(RunConfig(run="test"), spec)
    at = [f"unixsock-stream/{tmp_path}/{number}.sock" for number in range(2)]

    def serve(endpoint: str) -> Node:
        node = Node(open_session((endpoint,)), "test", "replay", new_incarnation())
        ReplayService(node, core, ReplayCheckpoints(tmp_path, 5)).start()
        return node

    def open_route(endpoints: Sequence[str]) -> zenoh.Session:
        opened.append((endpoints, session := open_session((), endpoints)))
        return session

    opened: list[tuple[Sequence[str], zenoh.Session]] = []
    first = serve(at[0])
    with ReplayRoute("test", 7, open_route, at[:1]) as route:
        wait_for("the first", lambda: route.is_up)
        stop = Stop()
        inserts = InsertClient(route, stop, window=1)
        given_up = threading.Timer(30, stop.set, ("nobody was found",))
        given_up.start()
        assert inserts.submit(make_segment(spec, 0))
        assert inserts.drain()
        first.close()
        wait_for("the end of the first", lambda: not route.is_up)
        assert inserts.submit(make_segment(spec, 1)), "under way to nobody"
        with serve(at[1]):
            route.follow([])  # as long as the learner knows of no other
            assert not route.is_up
            for _ in range(2):
                route.follow(at[1:])
            found = inserts.drain()
            given_up.cancel()
            assert found
            assert route.is_up
            assert [(endpoints, session.is_closed()) for endpoints, session in opened] == [
                (at[:1], True),
                (at[1:], False),
            ]
    assert core.table.inserted == 8


def test_a_second_is_refused_and_a_frozen_one_finds_its_successor(tmp_path: Path) -> None:
    endpoint, path = free_endpoint(), tmp_path / "run"
    joining = ("--run", "hand", "--connect", endpoint, "--join-timeout", "120")
    learning = ("--run", "hand", "--listen", endpoint, "--total-steps", "10000000", "--run-dir", str(path))
    metrics = path / "metrics.jsonl"
    with (
        Command("coop-learner", *learning) as learner,
        Command("coop-replay", *joining, "--run-dir", str(tmp_path / "first")) as first,
        Command("coop-actor", *joining) as actor,
    ):
        wait_for("the first metrics", lambda: lines(metrics) >= 1, 120)
        serving: list[int] = []
        with (
            Node(open_session((), (endpoint,)), "hand", "watch", new_incarnation()) as watcher,
            Command("coop-replay", *joining, "--run-dir", str(tmp_path / "second")) as second,
        ):
            watcher.session.declare_subscriber(
                status_key(watcher, "learner"),
                lambda sample: serving.append(LearnerStatus.decode(watcher.read(sample.payload)).connected["replay"]),
            )
            _, err = second.communicate(timeout=60)
        assert set(serving) == {1}, "the second does not count"
        assert second.returncode == 1
        host = socket.gethostname()
        assert f"run 'hand': the replay service on {host} (pid {first.pid}) serves this run\n" in err
        first.send_signal(signal.SIGSTOP)
        with Command("coop-replay", *joining, "--run-dir", str(tmp_path / "third")) as third:
            before = lines(metrics)
            wait_for("metrics with the third", lambda: lines(metrics) > before + 1)
            first.send_signal(signal.SIGCONT)
            _, err = first.communicate(timeout=60)
            assert first.returncode == 1
            assert re.search(rf"the replay service on {host} \(pid {third.pid}\) has taken over from this one\n$", err)
            before = lines(metrics)
            wait_for("more metrics with the third", lambda: lines(metrics) > before + 1)
            learner.send_signal(signal.SIGINT)
            for process in (learner, actor, third):
                process.wait(60)


@pytest.mark.parametrize("first", ["everybody", "replay"])
def test_whoever_is_told_to_stop_first_the_closing_checkpoint_is_saved(first: str, tmp_path: Path) -> None:
    endpoint, path = free_endpoint(), tmp_path / "run"
    joining = ("--run", "hand", "--connect", endpoint, "--join-timeout", "120")
    learning = ("--run", "hand", "--listen", endpoint, "--total-steps", "10000000", "--run-dir", str(path))
    serving = (*joining, "--run-dir", str(path), "--listen", "tcp/127.0.0.1:0")
    with (
        Command("coop-learner", *learning) as learner,
        Command("coop-replay", *serving) as replay,
        Command("coop-actor", *joining) as actor,
    ):
        wait_for("the first metrics", lambda: lines(path / "metrics.jsonl") >= 1, 120)
        if first == "everybody":
            for process in (actor, replay, learner):
                process.send_signal(signal.SIGTERM)
        else:
            replay.send_signal(signal.SIGTERM)
            replay.wait(40)
            saved = newest_checkpoint(path)
            assert saved is not None, "the checkpoint comes first"
            with Command("coop-replay", *serving, "--resume") as another:
                before = lines(path / "metrics.jsonl")
                wait_for("metrics with another one", lambda: lines(path / "metrics.jsonl") > before + 1)
                another.send_signal(signal.SIGTERM)
                another.wait(40)
            learner.send_signal(signal.SIGTERM)
        for process in (learner, replay, actor):
            process.wait(60)
    summary = json.loads((path / "summary.json").read_text())
    saved = newest_checkpoint(path)
    assert saved is not None
    assert saved.number == summary["updates"] > 0
    assert (saved.path / "replay" / "frames.npy").exists()
    assert summary["transitions_lost"] in (0, None)
