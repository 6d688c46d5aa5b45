"""Peers that freeze with a full link: the others are served all the same. And many links at once."""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh

from common.messaging import links
from common.messaging.links import locators
from common.messaging.messages.answers import Ack
from common.messaging.messages.weights import Current
from common.messaging.transport import Node, new_incarnation, open_session

FROZEN = 3  # more than the threads that Zenoh receives with, left to itself
LINKS = 20
LISTENER = """
import sys, time
from common.messaging.transport import open_session
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


def lingering(port: int) -> list[bool]:
    """Of each connection accepted at this port, whether closing it may block."""
    found = []
    for entry in Path("/proc/self/fd").iterdir():
        try:
            with socket.socket(fileno=os.dup(int(entry.name))) as opened:
                if opened.getsockname()[1] == port and opened.getpeername():
                    found.append(any(opened.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8)[:4]))
        except (OSError, IndexError):
            continue  # no such connection
    return found


def test_of_many_new_links_none_lingers_after_a_few_looks(server: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    """A look reads every descriptor of the process: one for each link would take the square of their number."""
    looks: list[float] = []
    treat = links._linger_off

    def look() -> None:
        looks.append(time.monotonic())
        treat()

    monkeypatch.setattr(links, "_linger_off", look)
    at = locators(server.session)
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps(at))
    with ExitStack() as stack:
        for _ in range(LINKS):
            stack.callback(zenoh.open(config).close)
        deadline = time.monotonic() + 30
        while (found := lingering(int(at[0].rpartition(":")[2]))) != [False] * LINKS:
            assert time.monotonic() < deadline, found
            time.sleep(0.05)
        assert looks
        assert all(later - earlier >= links.PAUSE for earlier, later in pairwise(looks))


def test_a_service_may_have_as_many_links_as_the_system_permits() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (before[1] // 2, before[1]))
    try:
        open_session(("tcp/127.0.0.1:0",)).close()  # type: ignore[no-untyped-call]
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (before[1], before[1])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
