"""Many links of one process: they join quickly, none may block the others, and the system's limit is the only one."""

import json
import os
import resource
import socket
import threading
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh
from samples import await_service, until

from coop.common.messaging import links
from coop.common.messaging.keys import weights_key
from coop.common.messaging.links import close, locators
from coop.common.messaging.messages.weights import Current
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.processes import ChildProcess, command

LINKS = 20


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


def test_of_many_new_links_none_lingers_after_a_few_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look reads every descriptor of the process: one for each link would take the square of their number."""
    looks: list[float] = []
    treat = links._linger_off

    def look() -> None:
        looks.append(time.monotonic())
        treat()

    monkeypatch.setattr(links, "_linger_off", look)
    with ExitStack() as stack:
        session = open_session(("tcp/127.0.0.1:0",))
        stack.callback(close, session)
        at = locators(session)
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps(at))
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
        close(open_session(("tcp/127.0.0.1:0",)))
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == (before[1], before[1])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_one_thread_for_all_sessions_ends_with_the_last(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "PAUSE", 30.0)
    before = set(threading.enumerate())
    first, second = open_session((endpoint,)), open_session((), (endpoint,))
    deadline = time.monotonic() + 20
    while not list(first.info.peers_zid()) and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.1)  # the thread has looked at the sockets, and pauses

    def followers() -> int:
        return sum(thread.name == "links" for thread in set(threading.enumerate()) - before)

    close(first)
    assert followers() == 1
    close(second)
    assert followers() == 0
    close(open_session((endpoint,)))
    assert followers() == 0, "and so again"


def test_an_actor_s_link_costs_the_learner_a_third_of_a_mebibyte(endpoint: str, tmp_path: Path) -> None:
    """Parameters fill a link's send queue, and its buffers remain: with those of other links, 0.8 MiB each."""
    wide = ("--network.hidden", "700", "700")  # 2 MB, more than the longest queue holds
    flags = ("--run=test", f"--run-dir={tmp_path / 'run'}", "--listen", endpoint, *wide)
    learner = ChildProcess("learner", command("coop-learner", *flags), tmp_path / "log")
    learner.start()

    def resident() -> float:
        pages = int(Path(f"/proc/{learner.pid}/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 2**20

    with ExitStack() as stack:
        stack.callback(learner.end, 0.0)

        def fetch() -> float:
            node = stack.enter_context(Node(open_session((), (endpoint,)), "test", "actor", new_incarnation()))
            key = weights_key(node, 1)
            await_service(node, key)
            assert node.ask(key, Current().encode("test")).kind == "weights"
            return resident()

        first = fetch()
        after = [fetch() for _ in range(LINKS)]
        assert (after[-1] - first) / LINKS < 0.55, (first, after)


def test_zenoh_s_threads_end_with_the_last_session(endpoint: str) -> None:
    """A process that ends before them would be killed by SIGABRT now and then."""
    for _ in range(LINKS):
        before = set(threading.enumerate())
        with (
            Node(open_session((endpoint,)), "test", "learner", new_incarnation()) as learner,
            Node(open_session((), (endpoint,)), "test", "actor", new_incarnation()) as actor,
        ):
            until(lambda: learner.presence.members("actor") and actor.presence.members("learner"))
        assert set(threading.enumerate()) <= before
