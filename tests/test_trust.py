"""The mutual-TLS set-up of deploy/zenoh: who is let in, and what an actor's certificate may do."""

import json
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import cycle
from pathlib import Path

import pytest
import zenoh
from samples import until

from coop.common.messaging.keys import evaluations_key, join_key, replay_key
from coop.common.messaging.members import ROUTE
from coop.common.messaging.messages.control import EndOfRun, Join, Leave, Limit, Limits, LimitsQuestion, Snapshot
from coop.common.messaging.messages.evaluate import Evaluated, EvaluationRow
from coop.common.messaging.messages.sample import encode_request
from coop.common.messaging.messages.status import ActorStatus, ReplayStats, StatsQuestion
from coop.common.messaging.messages.weights import Current
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import NoAnswer, Node, Refused, new_incarnation
from coop.common.process.processes import ChildProcess, command, free_endpoint
from coop.common.transitions import DrawRequest

MAKE_KEYS = Path(__file__).parents[1] / "deploy" / "zenoh" / "make_keys.sh"
pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="the script that makes keys needs openssl")
RUN = "trusted"
CA_LINE = re.compile(r'root_ca_certificate_base64: ".*"')
SLOW = """
import time
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

class Slow(CartPoleEnv):
    def step(self, action):
        time.sleep(0.004)
        return super().step(action)

gymnasium.register("Slow-v0", entry_point=Slow, max_episode_steps=200)
"""


def make_keys(folder: Path) -> Path:
    subprocess.run([str(MAKE_KEYS), str(folder)], check=True, capture_output=True)
    return folder


@contextmanager
def joined(at: tuple[str, str], config: Path | None, role: str = "actor") -> Iterator[Node]:
    with Node(open_session((), at, config), RUN, role, new_incarnation()) as node:
        yield node


def stats(node: Node) -> ReplayStats:
    return ReplayStats.decode(node.ask(replay_key(node, "stats"), StatsQuestion().encode(RUN)))


def training(node: Node) -> bool:
    try:
        return stats(node).drawn > 0
    except NoAnswer:
        return False


def wait_for_more(node: Node) -> None:
    """The run goes on: transitions and batches."""
    before = stats(node)
    deadline = time.monotonic() + 30
    while (now := stats(node)).inserted <= before.inserted + 100 or now.drawn <= before.drawn + 100:
        assert time.monotonic() < deadline, now
        time.sleep(0.05)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(tmp_path_factory.mktemp("trust") / "keys")


@pytest.fixture(scope="module")
def run(keys: Path, quick_children: None) -> Iterator[tuple[str, str]]:
    """Endpoints of learner and replay service of a run that goes on before and after each test, and ends well.

    It is slow, as it lasts as long as the tests do.
    """
    learner_at, replay_at = (free_endpoint("tls/127.0.0.1:0") for _ in range(2))
    folder = keys.parent / "run"
    joining = (f"--run={RUN}", "--connect", learner_at)
    files = f"--run-dir={folder}"
    (keys.parent / "slow_envs.py").write_text(SLOW)
    long = ("--total-steps=10000000", "--env.id=slow_envs:Slow-v0")
    commands = {
        "learner": command("coop-learner", f"--run={RUN}", files, "--listen", learner_at, *long),
        "replay": command("coop-replay", *joining, files, "--listen", replay_at),
        "actor": command("coop-actor", *joining, "--allow-import=slow_envs"),
    }
    with ExitStack() as stack:
        roles = []
        for name, line in commands.items():
            line += [f"--zenoh-config={keys / name}.json5"]
            role = ChildProcess(name, line, keys.parent / f"{name}.log", directory=keys.parent)
            role.start()
            stack.callback(role.end, 0.0)
            roles.append(role)
        with joined((learner_at, replay_at), keys / "replay.json5", "watch") as node:
            deadline = time.monotonic() + 100
            while not training(node):
                assert time.monotonic() < deadline, [role.last_line() for role in roles]
                time.sleep(0.1)
        yield learner_at, replay_at
        roles[0].interrupt()
        for role in roles:
            role.end(60.0)
        assert [role.exit_status() for role in roles] == [130, 0, 0], [role.last_line() for role in roles]
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["transitions_lost"], summary["exit"]) == (0, "interrupted")


def assert_outside(at: tuple[str, str], config: Path | None) -> None:
    with joined(at, config) as stranger:
        time.sleep(1.5)
        assert stranger.session.info.peers_zid() == []
        with pytest.raises(NoAnswer):
            stranger.ask(join_key(stranger, "actor"), Join("actor", 1, []).encode(RUN))


def test_strangers_stay_outside(run: tuple[str, str], keys: Path, tmp_path: Path) -> None:
    mine = (keys / "actor.json5").read_text()
    bare = tmp_path / "bare.json5"
    bare.write_text(re.sub(r'connect_\w+: ".*",\n', "", mine))
    foreign = tmp_path / "foreign.json5"
    other = (make_keys(tmp_path / "other") / "actor.json5").read_text()
    ours = CA_LINE.search(mine)
    assert ours is not None
    foreign.write_text(CA_LINE.sub(ours[0], other))
    plain = (run[0].replace("tls/", "tcp/"), run[1].replace("tls/", "tcp/"))
    with joined(run, keys / "replay.json5", "watch") as inside:
        for at, config in ((run, bare), (run, foreign), (plain, None)):
            assert_outside(at, config)
        wait_for_more(inside)
        with joined(run, keys / "actor.json5") as actor:
            assert actor.ask(join_key(actor, "actor"), Join("actor", 1, []).encode(RUN)).kind == "join-reply"


def test_an_actor_s_certificate_inserts_and_reads_weights_only(run: tuple[str, str], keys: Path) -> None:
    with joined(run, keys / "replay.json5", "watch") as inside, joined(run, keys / "actor.json5") as actor:
        before = stats(inside)
        assert actor.ask(actor.key("weights", "1"), Current().encode(RUN)).kind == "weights"
        for key, payload in (
            (replay_key(actor, "sample"), encode_request(RUN, DrawRequest(1, 0, 0, 32, 0))),
            (replay_key(actor, "stats"), StatsQuestion().encode(RUN)),
            (replay_key(actor, "limits"), Limit(1.0, 64.0).encode(RUN)),
            (replay_key(actor, "snapshot"), Snapshot(1, [], 1, 0).encode(RUN)),
            (join_key(actor, "replay"), Join("replay", 1, ["tls/127.0.0.1:9"]).encode(RUN)),
        ):
            with pytest.raises(NoAnswer):
                actor.ask(key, payload)
        for _ in range(20):
            actor.announce(actor.key("stop"), EndOfRun.because("forged").encode(RUN))
            actor.session.delete(actor.key("stop"))
        token = actor.session.liveliness().declare_token(actor.key("alive", "learner", "0"))
        overheard = actor.session.declare_subscriber(actor.key("metrics", "**"), zenoh.handlers.FifoChannel(8))
        wait_for_more(inside)
        assert inside.presence.counts()["learner"] == 1, "an actor can't pass for a learner"
        assert overheard.try_recv() is None
        token.undeclare()
        assert stats(inside).bad_messages == before.bad_messages, "nothing of it came through"


def test_an_actor_s_own_link_to_the_replay_service_is_counted(keys: Path) -> None:
    """The service shares out what may be in flight among the links that it sees."""
    at = free_endpoint("tls/127.0.0.1:0")
    with Node(open_session((at,), (), keys / "replay.json5"), RUN, "replay", new_incarnation()) as replay:
        with Node(open_session((), (at,), keys / "actor.json5"), RUN, ROUTE, new_incarnation()):
            until(lambda: replay.presence.counts().get(ROUTE) == 1)
        until(lambda: ROUTE not in replay.presence.counts())


def test_an_evaluator_s_certificate_reads_weights_and_reports(run: tuple[str, str], keys: Path) -> None:
    report = Evaluated(1, 0, EvaluationRow(0, 0, 1, 1, 1.0, 0.0, 0.0, 1.0)).encode(RUN)
    with joined(run, keys / "evaluator.json5", "evaluator") as evaluator, joined(run, keys / "actor.json5") as actor:
        joining = Join("evaluator", 5, []).encode(RUN)
        assert evaluator.ask(join_key(evaluator, "evaluator"), joining).kind == "join-reply"
        assert evaluator.ask(evaluator.key("weights", "1"), Current().encode(RUN)).kind == "weights"
        assert evaluator.ask(evaluations_key(evaluator), report).kind == "ack"
        for node, key, payload in (
            (actor, evaluations_key(actor), report),
            (evaluator, replay_key(evaluator, "insert"), encode_request(RUN, DrawRequest(1, 0, 0, 32, 0))),
            (evaluator, replay_key(evaluator, "stats"), StatsQuestion().encode(RUN)),
        ):
            with pytest.raises(NoAnswer):
                node.ask(key, payload)


@contextmanager
def client(at: str, config_file: Path) -> Iterator[zenoh.Session]:
    """A Zenoh client: others forward what it tells, and it asks whoever may answer."""
    config = zenoh.Config.from_file(str(config_file))
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([at]))
    with zenoh.open(config) as session:
        yield session


@pytest.mark.parametrize("role", ["actor", "evaluator"])
def test_an_actor_s_or_evaluator_s_certificate_can_t_set_limits(role: str, run: tuple[str, str], keys: Path) -> None:
    with joined(run, keys / "replay.json5", "watch") as inside, client(run[1], keys / f"{role}.json5") as forger:
        key, question = replay_key(inside, "limits"), LimitsQuestion().encode(RUN)
        before = Limits.decode(inside.ask(key, question))
        heard = list(forger.get(replay_key(inside, "insert"), payload=b"junk", timeout=1.0))
        assert bool(heard) == (role == "actor")
        assert list(forger.get(key, payload=bytes(Limit(0.5, 32.0).encode(RUN)), timeout=1.0)) == []
        after = Limits.decode(inside.ask(key, question))
        assert (after.ratio, after.tolerance) == (before.ratio, before.tolerance)


def test_an_actor_s_certificate_can_t_publish_weights(run: tuple[str, str], keys: Path) -> None:
    with joined(run, keys / "actor.json5") as actor, client(run[0], keys / "actor.json5") as forger:
        key = actor.key("weights", "1")
        received = actor.session.declare_subscriber(key, zenoh.handlers.FifoChannel(10_000))
        time.sleep(0.5)
        for _ in range(100):
            forger.put(key, b"forged", congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(0.01)
        payloads = []
        while (sample := received.try_recv()) is not None:
            payloads.append(sample.payload.to_bytes())
        assert payloads
        assert b"forged" not in payloads


HELLO = bytes.fromhex("16030100cd010000c90303") + bytes(40)  # the beginning of a ClientHello of 210 bytes
WORDS = (b"", HELLO[:1], HELLO[:11], HELLO)


@contextmanager
def idle(at: str, count: int, *words: bytes) -> Iterator[list[socket.socket]]:
    """Connections that say nothing, or no more than one of some words in turn."""
    place = "127.0.0.1", int(at.rpartition(":")[2])
    with ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection(place)) for _ in range(count)]
        for each, said in zip(silent, cycle(words)):
            each.sendall(said)
        yield silent


def seconds_to_join(run: tuple[str, str], config: Path | None) -> float:
    began = time.monotonic()
    with joined(run, config) as actor:
        while time.monotonic() - began < 60:
            with suppress(NoAnswer):
                assert actor.ask(join_key(actor, "actor"), Join("actor", 1, []).encode(RUN)).kind == "join-reply"
                until(lambda: actor.presence.members("replay"))
                break
        return time.monotonic() - began


def test_idle_connections_keep_nobody_out(run: tuple[str, str], keys: Path) -> None:
    """Neither while they are there, nor when their handshakes have taken too long, nor when they go."""
    with joined(run, keys / "replay.json5", "watch") as inside:
        with ExitStack() as stack:
            for at in run:
                stack.enter_context(idle(at, 500, *WORDS))
            assert seconds_to_join(run, keys / "actor.json5") < 5
            time.sleep(11)  # Zenoh gives a handshake 10 s
            assert seconds_to_join(run, keys / "actor.json5") < 5
            wait_for_more(inside)
        assert seconds_to_join(run, keys / "actor.json5") < 5
        wait_for_more(inside)


def test_strangers_who_begin_to_speak_keep_nobody_out_and_are_sent_away() -> None:
    at = free_endpoint("tcp/127.0.0.1:0")
    with Node(open_session((at,)), RUN, "learner", new_incarnation()), idle(at, 300, b"\x00") as strangers:
        time.sleep(0.5)
        with joined((at, at), None) as actor:
            until(lambda: actor.presence.members("learner"), 4.0)
        strangers[0].settimeout(20.0)
        with suppress(ConnectionResetError):
            assert strangers[0].recv(1) == b""


@pytest.mark.parametrize("protocol", ["tls", "tcp"])
def test_a_listener_hears_only_of_those_who_speak(protocol: str, keys: Path) -> None:
    at = free_endpoint(f"{protocol}/127.0.0.1:0")
    configs = (keys / "learner.json5", keys / "actor.json5") if protocol == "tls" else (None, None)
    with Node(open_session((at,), (), configs[0]), RUN, "learner", new_incarnation()) as learner:
        before = len(list(Path("/proc/self/fd").iterdir()))
        with idle(at, 100, b"") as silent:
            time.sleep(0.2)
            assert len(list(Path("/proc/self/fd").iterdir())) - before == 100, "these ends of the connections alone"
            with joined((at, at), configs[1]) as actor:
                until(lambda: actor.presence.members("learner") and learner.presence.members("actor"))
                for _ in range(20):  # both ways, also once the filter of its listener is gone
                    actor.announce(actor.key("metrics", "actor", "1"), bytearray(1 << 20))
                    time.sleep(0.02)
            silent[0].sendall(b"GET / HTTP/1.0\r\n\r\n")
            until(lambda: len(list(Path("/proc/self/fd").iterdir())) - before >= 100)
        until(lambda: not learner.presence.members("actor"))


def test_an_actor_s_certificate_can_t_take_another_s_place(run: tuple[str, str], keys: Path) -> None:
    """Neither by the identity of learner or replay service, nor by a message in their name."""
    with joined(run, keys / "replay.json5", "watch") as inside, joined(run, keys / "actor.json5") as actor:
        until(lambda: len(actor.session.info.peers_zid()) == 2)
        replay = next(iter(inside.presence.members("replay")))
        for zid in map(str, actor.session.info.peers_zid()):
            config = zenoh.Config.from_file(str(keys / "actor.json5"))
            config.insert_json5("id", json.dumps(zid))
            config.insert_json5("connect/endpoints", json.dumps(run))
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("listen/endpoints", "[]")
            with zenoh.open(config) as spoofed:
                key = actor.key("alive", "replay", replay)
                token = spoofed.liveliness().declare_token(key)
                spoofed.put(actor.key("stop"), bytes(EndOfRun.because("forged").encode(RUN)))
                time.sleep(1)
                token.undeclare()
        with pytest.raises(Refused, match="not an actor's"):
            actor.ask(join_key(actor, "actor"), Leave(int(replay, 16)).encode(RUN))
        for _ in range(3):
            with pytest.raises(NoAnswer):
                actor.ask(join_key(actor, "replay"), Leave(int(replay, 16)).encode(RUN))
        wait_for_more(inside)
        assert inside.presence.members("replay") == {replay}


def test_malformed_messages_of_an_actor_are_refused_counted_and_named(run: tuple[str, str], keys: Path) -> None:
    folder = keys.parent
    with joined(run, keys / "replay.json5", "watch") as inside, joined(run, keys / "actor.json5") as actor:
        before = stats(inside).bad_messages
        for payload in (b"", b"\x00" * 64, bytes(encode_request(RUN, DrawRequest(1, 0, 0, 32, 0))), bytes(1 << 22)):
            with pytest.raises(Refused):
                actor.ask(replay_key(actor, "insert"), bytearray(payload))
        assert stats(inside).bad_messages == before + 4
        token = actor.session.liveliness().declare_token(actor.key("alive", "actor", "no-number"))
        for payload in (bytearray(b"junk"), ActorStatus(1, 1).encode(RUN)) * 30:
            actor.announce(actor.key("metrics", "actor", "\u202enobody"), payload)
        until(lambda: "alive/actor: key: 'no-number' is no incarnation" in (folder / "learner.log").read_text())
        token.undeclare()
        wait_for_more(inside)
    assert f"refused a message at coop/{RUN}/replay/0/insert: " in (folder / "replay.log").read_text()
    log = (folder / "learner.log").read_text()
    assert "error of this program" not in log
    for field in ("payload", "key"):
        assert log.count(f"refused a message at coop/{RUN}/metrics/actor/*: {field}: ") == 1, "one line for many"
    assert "\u202e" not in log
