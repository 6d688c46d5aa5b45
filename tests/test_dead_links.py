"""Peers that freeze with a full link, and hosts that never answer: all others are served all the same."""

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from coop.common.messaging.links import locators
from coop.common.messaging.messages.answers import Ack
from coop.common.messaging.messages.weights import Current
from coop.common.messaging.route import CLOSING, ReplayRoute
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation

FROZEN = 3  # more than the threads that Zenoh receives with, left to itself
LISTENER = """
import sys, time
from coop.common.messaging.session import open_session
session = open_session((), (sys.argv[1],))
subscriber = session.declare_subscriber("coop/test/weights/1", lambda sample: None)
print("ready", flush=True)
time.sleep(120)
"""


@pytest.fixture
def server() -> Iterator[Node]:
    with Node(open_session(("tcp/127.0.0.1:0",)), "test", "learner", new_incarnation()) as node:
        node.serve(node.key("role"), lambda message: Ack(1).encode("test"))
        yield node


def test_frozen_peers_do_not_make_a_process_deaf(server: Node) -> None:
    at = locators(server.session)
    with ExitStack() as stack:
        frozen = []
        for _ in range(FROZEN):
            process = stack.enter_context(
                subprocess.Popen([sys.executable, "-c", LISTENER, at[0]], stdout=subprocess.PIPE)
            )
            stack.callback(process.kill)
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            frozen.append(process)
        client = stack.enter_context(Node(open_session((), at), "test", "actor", new_incarnation()))
        while len(server.session.info.peers_zid()) < FROZEN + 1:
            time.sleep(0.05)
        for process in frozen:
            process.send_signal(signal.SIGSTOP)
        weights, question = bytearray(1 << 20), Current().encode("test")
        while len(server.session.info.peers_zid()) > 1:
            server.publish(server.key("weights", "1"), weights)
            client.ask(client.key("role"), question, timeout=4.0)
            time.sleep(0.02)
        for _ in range(20):
            client.ask(client.key("role"), question, timeout=4.0)
            time.sleep(0.1)


def test_a_route_leaves_a_host_that_never_answers_at_once(server: Node, tmp_path: Path) -> None:
    patient = tmp_path / "zenoh.json5"
    patient.write_text("{transport: {unicast: {open_timeout: 30000}}}")  # longer than closing may take
    with socket.create_server(("127.0.0.1", 0)) as silent:
        nowhere = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        with ReplayRoute("test", 7, lambda endpoints: open_session((), endpoints, patient), [nowhere]) as route:
            began = time.monotonic()
            route.follow(locators(server.session))
            assert time.monotonic() - began < 8.0
            assert Ack.decode(route.begin(route.key("role"), Current().encode("test"), 5.0).wait()).inserted == 1
        for thread in threading.enumerate():
            if thread.name == CLOSING:
                thread.join()  # where closing failed, so does this test
