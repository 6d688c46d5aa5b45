"""Who may join, who is named when it goes, and when the dead are started again."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from msgspec.structs import replace
from samples import await_service, make_segment

from coop.common.errors import JoinError
from coop.common.messaging import joining, wire
from coop.common.messaging.joining import difference, join, leave_run
from coop.common.messaging.keys import join_key, replay_key, stop_key
from coop.common.messaging.members import Origin
from coop.common.messaging.messages.control import (
    EndOfRun,
    Join,
    JoinReply,
    Leave,
    Limit,
    Limits,
    LimitsQuestion,
    Snapshot,
)
from coop.common.messaging.messages.sample import encode_request
from coop.common.messaging.messages.weights import Current, Role
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import NoAnswer, Node, Refused
from coop.common.process.lifecycle import Stop
from coop.common.settings.config import RunConfig
from coop.common.transitions import DrawRequest
from coop.common.types import EnvSpec
from coop.deploy.supervisor import HEALTHY, RESTARTS, RestartPolicy
from coop.learner.join_service import JoinService
from coop.learner.roster import Roster
from coop.learner.shared_checkpoints import SharedCheckpoints
from coop.replay.core import ReplayCore
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.service import ReplayService

REQUEST = Join("actor", 3, [])


def _receive(node: Node, spec: EnvSpec) -> None:
    JoinService(node, RunConfig(run="test"), spec, "layout", 9, SharedCheckpoints([], "run"), Roster(), print)


def test_another_protocol_is_refused_with_both_versions(
    nodes: tuple[Node, Node], spec: EnvSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, actor = nodes
    with monkeypatch.context() as patch:
        patch.setattr(wire, "PROTOCOL", wire.PROTOCOL + 2)
        payload = REQUEST.encode("test")
        newer = EndOfRun.because("an answer of another protocol").encode("test")
    # Before the join service, so that who has joined knows of it too.
    learner.serve(learner.key("newer"), lambda message: newer)
    _receive(learner, spec)
    assert join(actor, Stop(), REQUEST, (), 5) is not None
    refusal = f"version {wire.PROTOCOL + 2}; this process speaks {wire.PROTOCOL}"
    with pytest.raises(Refused, match=refusal):
        actor.ask(join_key(actor, "actor"), payload)
    with pytest.raises(Refused, match=refusal):
        actor.ask(actor.key("newer"), Current().encode("test"))


def test_another_run_is_named(nodes: tuple[Node, Node], endpoint: str) -> None:
    with (
        Node(open_session((), (endpoint,)), "other", "joining", 1) as stranger,
        pytest.raises(JoinError, match="no learner of run 'other' found at there within 1 s; there is run 'test'"),
    ):
        join(stranger, Stop(), REQUEST, ("there",), 1)


def test_nothing_of_another_run_of_the_same_name_is_taken(
    nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path
) -> None:
    here, there = nodes
    folder = tmp_path / "replay"
    core = ReplayCore(RunConfig(run="test"), spec)
    ReplayService(here, core, ReplayCheckpoints(folder, 5)).start()
    here.serve("coop/test/role", lambda message: Role(1, (0, 0), 0, 0).encode("test#6"))
    await_service(there, replay_key(there, "snapshot"))  # the last one that the service declares
    stop = Stop()
    here.follow_stop(stop)
    draw = DrawRequest(1, 0, 0, core.batch_size, 0)
    here.belong(5)
    there.belong(6)
    await_service(there, "coop/test/role")
    for key, request in (
        ("sample", encode_request(there.run, draw)),
        ("snapshot", Snapshot(5, [], 1, 0).encode("test#6")),
    ):
        with pytest.raises(Refused, match=r"^run: 'test#6'; this is run 'test#5'$"):
            there.ask(replay_key(there, key), request)
    assert (core.drawn, core.repeatable(), folder.exists()) == (0, [], False)
    there.announce(stop_key(there), EndOfRun.because("complete").encode(there.run))
    there.belong(5)
    with pytest.raises(NoAnswer, match="run: 'test#6'; this is run 'test#5'"):
        there.ask("coop/test/role", Current().encode(there.run))
    assert there.ask(replay_key(there, "sample"), encode_request(there.run, draw)).kind == "retry"
    there.announce(stop_key(there), EndOfRun.because("interrupted").encode(there.run))
    assert stop.wait(10)
    assert "interrupted" in stop.reason


def test_who_has_joined_belongs_to_that_run_alone(nodes: tuple[Node, Node], spec: EnvSpec) -> None:
    learner, actor = nodes
    _receive(learner, spec)
    await_service(actor, join_key(actor, "actor"))
    assert actor.run == "test"
    assert join(actor, Stop(), REQUEST, ("there",), 5) is not None
    assert (actor.run, actor.run_name, actor.key("role")) == ("test#9", "test", "coop/test/role")
    learner.belong(10)  # another one, at the same address
    with pytest.raises(JoinError, match=r"^the learner of run 'test' refused: run: 'test#9'; this is run 'test#a'$"):
        join(actor, Stop(), REQUEST, ("there",), 5)


MINE = JoinReply(RunConfig(), EnvSpec("CartPole-v0", (4,), "float32", 1, 2), "abc", 0, [], 5, 0)


@pytest.mark.parametrize(
    ("theirs", "words"),
    [
        (replace(MINE, index=4, checkpoint=300, replay_endpoints=["x"]), None),
        (replace(MINE, config=RunConfig(checkpoint_every=7)), None),
        (replace(MINE, run_id=6), "run id here 5, the learner's 6"),
        (replace(MINE, layout="abd"), "network layout here abc, the learner's abd"),
        (replace(MINE, spec=replace(MINE.spec, num_actions=3)), "environment.num_actions here 2, the learner's 3"),
        (replace(MINE, config=RunConfig(seed=1)), "config.seed here 0, the learner's 1"),
    ],
)
def test_another_learner(theirs: JoinReply, words: str | None) -> None:
    assert difference(MINE, theirs) == words


def test_presence(nodes: tuple[Node, Node], endpoint: str) -> None:
    learner, _ = nodes
    changes: list[tuple[str, int, bool]] = []
    learner.presence.on_change(lambda *change: changes.append(change))

    def wait_for(reached: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 10
        while not reached():
            assert time.monotonic() < deadline, (learner.presence.counts(), changes)
            time.sleep(0.01)

    wait_for(lambda: learner.presence.counts() == {"learner": 1, "actor": 1})
    with Node(open_session((), (endpoint,)), "test", "replay", 0xAB):
        wait_for(lambda: learner.presence.counts() == {"learner": 1, "actor": 1, "replay": 1})
        assert learner.presence.members("replay") == {"ab"}
        assert learner.presence.absence("replay") == 0.0
        there = time.monotonic()
    wait_for(lambda: learner.presence.counts() == {"learner": 1, "actor": 1})
    assert 0 < learner.presence.absence("replay") < time.monotonic() - there
    wait_for(lambda: [there for role, who, there in changes if (role, who) == ("replay", 0xAB)] == [True, False])


def test_who_joins_and_leaves_is_told(nodes: tuple[Node, Node], spec: EnvSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joining, "HANDOVER_TIMEOUT", 0.0)
    learner, actor = nodes
    events: list[str] = []
    join_service = JoinService(
        learner, RunConfig(run="test"), spec, "layout", 9, SharedCheckpoints([], "run"), Roster(), events.append
    )
    service = Join("replay", 5, ["tcp/rep:1"], origin=Origin("rep", 7))
    other = replace(service, incarnation=6, origin=Origin("rep", 8))
    assert join(actor, Stop(), service, (), 5) is not None
    with pytest.raises(JoinError, match=r"run 'test': the replay service on rep \(pid 7\) serves this run"):
        join(actor, Stop(), other, (), 5)
    watching = join(actor, Stop(), Join("watch", 9, []), (), 5)
    assert watching is not None
    assert (watching.index, watching.replay_endpoints, watching.replay) == (0, ["tcp/rep:1"], Origin("rep", 7))
    payload = Leave(5).encode("test")
    with pytest.raises(Refused, match="not an actor's"):
        actor.ask(join_key(actor, "actor"), payload)
    assert not join_service.departure.is_due
    assert actor.ask(join_key(actor, "replay"), payload).kind == "retry", "a checkpoint comes first"
    assert join_service.departure.is_due
    join_service.departure.grant()
    assert not join_service.departure.is_due
    assert actor.ask(join_key(actor, "replay"), payload).kind == "farewell"
    assert join(actor, Stop(), other, (), 5) is not None
    leave_run(actor, Join("actor", 3, []))
    with pytest.raises(JoinError, match=r"the replay service on rep \(pid 8\) has taken over from this one"):
        join(actor, Stop(), replace(service, index=0), (), 5)
    payload = Leave(6).encode("test")
    assert actor.ask(join_key(actor, "replay"), payload).kind == "retry", "another one's departure was granted"
    join_service.departure.end()
    assert actor.ask(join_key(actor, "replay"), payload).kind == "farewell"
    assert events == [
        "replay service on rep (pid 7) joined; it listens on tcp/rep:1",
        "replay service on rep (pid 8) joined; it listens on tcp/rep:1",
    ]


def test_who_hears_nonsense_leaves_at_once(nodes: tuple[Node, Node]) -> None:
    learner, actor = nodes
    key = join_key(actor, "actor")

    def nonsense(query: zenoh.Query) -> None:
        with query:
            query.reply(key, b"nonsense")

    learner.session.declare_queryable(key, nonsense, complete=True)
    await_service(actor, key)
    with pytest.raises(JoinError, match="no learner of run 'test' found"):
        join(actor, Stop(), Join("actor", 3, []), (), 0.3)
    began = time.monotonic()
    leave_run(actor, Join("actor", 3, []))
    assert time.monotonic() - began < 5, "of the time for a learner that is busy"


def test_the_limiter_changes_while_the_run_goes_on(nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path) -> None:
    server, client = nodes
    config = RunConfig(run="test", total_steps=1000)
    core = ReplayCore(config, spec)
    ReplayService(server, core, ReplayCheckpoints(tmp_path, 5)).start()
    await_service(client, replay_key(client, "snapshot"))  # the last one that it declares
    key = replay_key(client, "limits")
    for sequence in range(125):
        core.insert(make_segment(spec, sequence))
    request = DrawRequest(1, 0, 0, config.learner.batch_size, 0)
    drawn = client.ask(replay_key(client, "sample"), encode_request("test", request))
    assert drawn.fields["planned"] == 500
    now = Limits.decode(client.ask(key, Limit(0.5, 16).encode("test")))
    assert (now.ratio, now.tolerance, now.inserted, now.drawn, now.planned) == (0.5, 16, 500, 1, 251)
    assert Limits.decode(client.ask(key, LimitsQuestion().encode("test"))) == now
    for ratio, tolerance, field in ((0.0, 1.0, "ratio"), (1.0, -1.0, "tolerance")):
        with pytest.raises(Refused, match=field):
            client.ask(key, Limit(ratio, tolerance).encode("test"))
    assert core.limiter.ratio == 0.5


def test_restarts_are_bounded_and_slow_down() -> None:
    policy, now, pauses = RestartPolicy(), 100.0, []
    while not policy.ended(now):
        assert policy.at is not None
        assert len(pauses) < RESTARTS
        assert not policy.due(policy.at - 0.01)
        pauses.append(policy.at - now)
        now = policy.at
        assert policy.due(now)
        assert not policy.due(now)
    assert len(pauses) == RESTARTS
    assert pauses[:6] == pytest.approx([0.25, 0.5, 1, 2, 4, 4])
    assert not policy.ended(now + HEALTHY), "a healthy spell, and the past is forgotten"
    assert policy.ends == 1
