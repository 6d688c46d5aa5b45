"""Actors behind a router: one address, one link each, and nothing lost."""

import json
import signal
import subprocess
import sysconfig
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from commands import run_command
from samples import until

from coop.common.errors import JoinError
from coop.common.messaging.keys import replay_key
from coop.common.messaging.links import close
from coop.common.messaging.messages.answers import Ack
from coop.common.messaging.route import RoutedReplay, open_client
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.lifecycle import Stop
from coop.common.process.processes import free_endpoint
from coop.deploy.router import links

wait_for = partial(until, seconds=60.0)


def test_one_link_carries_everything() -> None:
    learner_at, replay_at, router_at = (free_endpoint() for _ in range(3))
    with (
        Node(open_session((learner_at,)), "test", "learner", new_incarnation()) as learner,
        Node(open_session((replay_at,), (learner_at, router_at)), "test", "replay", new_incarnation()) as replay,
    ):
        replay.serve(replay_key(replay, "insert"), lambda message: Ack(7).encode("test"))
        router = open_session((router_at,), (learner_at,), mode="router")
        try:
            session = open_client((router_at,), None, False, 10.0, Stop())
            assert session is not None
            with Node(session, "test", "actor", new_incarnation()) as node, RoutedReplay(node) as route:
                wait_for(lambda: route.is_up and node.presence.members("learner"))
                pending = route.begin(replay_key(route, "insert"), Ack(0).encode("test"), 5.0)
                assert Ack.decode(pending.wait()).inserted == 7
                assert (len(session.info.routers_zid()), len(session.info.peers_zid())) == (1, 0)
                role = node.latest(node.key("role"))

                def asked() -> object:
                    learner.announce(learner.key("role"), Ack(3).encode("test"))
                    return role.poll()

                wait_for(asked)
                wait_for(lambda: learner.presence.members("actor"))
                wait_for(lambda: replay.presence.members("actor"))  # by which it shares out what may be in flight
                assert links(router) == "connected: 2 services, 1 actor"
        finally:
            close(router)


def test_no_router() -> None:
    nowhere = free_endpoint()
    with pytest.raises(JoinError, match=rf"^no router at {nowhere} within 0 s$"):
        open_client((nowhere,), None, False, 0.0, Stop())
    stop = Stop()
    stop.set("interrupted")
    assert open_client((nowhere,), None, False, 60.0, stop) is None


def test_a_config_that_is_none(tmp_path: Path) -> None:
    config = tmp_path / "zenoh.json5"
    for text, words in (
        ("{mode: 1}", "JSON error: "),
        ("{\n mode:\n", "line 3:1: expected "),
        ("", "Empty config file"),
    ):
        config.write_text(text)
        done = run_command("coop-router", "--zenoh-config", config)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith(f"coop-router: error: --zenoh-config {config}: {words}")
        assert done.stderr.count("\n") == 1


def test_a_run_behind_a_router(tmp_path: Path) -> None:
    learner, replay, router = (free_endpoint() for _ in range(3))
    health = [free_endpoint().partition("/")[2] for _ in range(4)]
    settings = ["--preset=cartpole", "--total-steps=1500", f"--run-dir={tmp_path}"]
    serving = ["--connect", learner, router, "--listen", replay, "--advertise", "tcp/replay:1", "--health", health[1]]
    command = [Path(sysconfig.get_path("scripts"), "coop-router"), "--connect", learner, "--listen", router]
    with ThreadPoolExecutor() as pool:
        playing = ["--mode=client", "--connect", router, "--health", health[2]]
        trained = pool.submit(run_command, "coop-learner", *settings, "--listen", learner, "--health", health[0])
        with subprocess.Popen([*command, "--health", health[3]], stdout=subprocess.PIPE, text=True) as process:
            try:
                for address in (health[3], health[0]):  # they work without the others
                    wait_for(partial(is_ready, address))
                actor = pool.submit(run_command, "coop-actor", *playing, check=True)
                pool.submit(run_command, "coop-replay", *serving, cwd=tmp_path)
                for address in health[1:3]:
                    wait_for(partial(is_ready, address))
                another = open_client((router,), None, False, 10.0, Stop())
                assert another is not None
                assert len(another.info.routers_zid()) == 1, "not a peer, which would forward as well"
                close(another)
                done = trained.result()
                assert done.returncode == 0
                actor.result()
            finally:
                process.send_signal(signal.SIGINT)
                assert process.wait(30) == 130
            assert process.stdout is not None
            assert process.stdout.readline().endswith(f" router listens on {router}\n")
    assert "joined; it listens on tcp/replay:1\n" in done.stdout
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["exit"], summary["transitions_lost"]) == ("complete", 0)


def is_ready(address: str) -> bool:
    try:
        with urllib.request.urlopen(f"http://{address}/ready", timeout=30):
            return True
    except OSError:
        return False
