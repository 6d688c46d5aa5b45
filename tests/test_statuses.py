"""What the learner tells of a run: who is there and how, who waits for whom, speeds, and returns so far."""

import time
from collections.abc import Callable

import pytest
from msgspec.structs import replace

from coop.common.messaging.keys import status_key
from coop.common.messaging.members import Origin
from coop.common.messaging.messages.control import Join
from coop.common.messaging.messages.status import ActorStatus, Held, Member, Ratio, ReplayStatus, Wait
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.session import open_session
from coop.common.messaging.timing import FORGOTTEN, HOLD
from coop.common.messaging.transport import Node
from coop.common.numbers import Rate
from coop.common.process.console import Console
from coop.common.process.lifecycle import Stop
from coop.common.types import EnvSpec
from coop.learner.join_service import JoinService
from coop.learner.roster import MemberTracker, Roster
from coop.learner.shared_checkpoints import SharedCheckpoints
from coop.learner.status import MEMBERS_EVERY, StatusReporter, waits
from coop.learner.telemetry import ReturnHistory
from coop.lockstep.lockstep import Lockstep
from coop.records.run_options import base_config
from coop.replay.gate import Gate


def test_who_waits_for_whom() -> None:
    calm = ReplayStatus(1, 1, 1, Ratio(1.0, None, 0.0, -8.0, 12.0))
    ahead = replace(calm, inserts=Held(0.5, "inserts are 9 steps ahead of updates"))
    behind = replace(calm, samples=Held(0.9, "waiting for 9 transitions, have 1"))
    brief = replace(calm, inserts=Held(0.01, "inserts are 9 steps ahead of updates"))
    full = replace(calm, inserts=Held(1.0, "the journal can't be written: No space left on device"))
    stuck = [Member("actor 0", "actor", "n", 1, "waiting", 0.0, "waiting for the learner's weights")]
    silent, gone = "the replay service does not answer", "the replay service"
    for replay, learner, members, expected in (
        (calm, "", [], []),
        (brief, "", [], []),
        (ahead, "", stuck, [Wait("actors", "the learner", 0.5, "inserts are 9 steps ahead of updates")]),
        (behind, "r", [], [Wait("the learner", "actors", 0.9, "waiting for 9 transitions, have 1")]),
        (calm, "", stuck, [Wait("actors", "the learner", 1.0, "waiting for the learner's weights")]),
        (calm, silent, [], [Wait("the learner", gone, 1.0, silent)]),
        (None, "r", stuck, [Wait("the learner", gone, 1.0, "r"), Wait("actors", gone, 1.0, stuck[0].reason)]),
        (full, "", [], [Wait("actors", gone, 1.0, full.inserts.reason)]),
    ):
        assert waits(replay, learner, members) == expected


def test_how_long_a_gate_holds_up_requests() -> None:
    gate = Gate(10.0)
    assert gate.refuse("a", 10.2) == HOLD
    assert gate.refuse("b", 10.3) == pytest.approx(HOLD - 0.1), "since the gate closed"
    gate.admit(10.4)
    assert gate.held(10.5) == Held(pytest.approx(0.4), "b")
    assert gate.held(11.5) == Held(0.0, "")
    gate.refuse("c", 12.0)
    assert gate.held(12.5) == Held(pytest.approx(0.5), "c"), "it is still closed"
    gate.refuse("d", 12.6)
    assert gate.held(13.5) == Held(1.0, "d")
    assert gate.held(17.5) == Held(pytest.approx(1.6 / 4), "d"), "whoever asked at 12.6 has gone"
    assert gate.held(18.5) == Held(0.0, "")
    assert gate.refuse("e", 18.6) < 0
    gate.admit(18.7)
    assert gate.held(18.7) == Held(1.0, "e")
    assert gate.held(19.7) == Held(0.0, "")


def test_a_rate_looks_back_over_its_window() -> None:
    rate = Rate(2.0)
    assert rate.at(0.0, 100) == 0.0
    assert rate.at(0.0, 110) == 0.0
    assert rate.at(0.5, 160) == 100.0
    assert rate.at(3.0, 160) == 0.0, "nothing since 0.5"
    assert rate.at(3.5, 165) == pytest.approx(5 / 3), "since 0.5, the last look before the window"
    assert rate.at(4.0, 0) == 0.0, "a count that falls has no rate"


def test_the_history_of_returns_covers_the_run() -> None:
    history = ReturnHistory()
    for episode in range(1, 1001):
        history.add(episode, float(episode))
    assert history.values == [float(episode) for episode in range(8, 1001, 8)]
    again = ReturnHistory()
    again.load_state(history.state())
    for one in (history, again):
        one.add(1001, 0.0)
        one.add(1008, 1008.0)
    assert history.values == again.values == [float(episode) for episode in range(8, 1009, 8)]


def test_members_are_listed_with_their_states() -> None:
    members = MemberTracker(lambda line: None)
    members.add(Join("replay", 1, ["tcp/rep:1"], origin=Origin("rep", 7)), "replay service")
    members.add(Join("actor", 2, [], origin=Origin("act", 8)), "actor 0")
    members.add(Join("actor", 3, [], origin=Origin("act", 9)), "actor 1")
    members.report(2, ActorStatus(10, 8, 55.0))
    members.report(3, ActorStatus(10, 8, 1.0, "because"))
    members.report(99, ActorStatus(10, 8))
    service = Member("replay service", "replay", "rep", 7, "serving")
    first = Member("actor 0", "actor", "act", 8, "playing", 55.0)
    second = Member("actor 1", "actor", "act", 9, "waiting", 1.0, "because")
    assert members.listed(0.0, 9) == [service, first, second]
    members.token("actor", 2, False, 1.0)
    members.leaving(3)
    members.token("actor", 3, False, 1.0)
    lost = Member("actor 0", "actor", "act", 8, "lost")
    assert members.listed(1.0, 9) == [lost, service]
    assert members.listed(1.0, 1) == [lost]
    assert members.listed(1.0 + FORGOTTEN, 9) == [service]
    members.token("actor", 2, True, 2.0)
    assert members.listed(2.0, 9) == [service, first]
    members.add(Join("actor", 99, [], origin=Origin("act", 10)), "actor 2")
    assert members.listed(2.0, 9)[2] == Member("actor 2", "actor", "act", 10, "playing"), "nothing from before its join"


def test_members_that_come_and_go_at_once_are_published_ten_times_a_second(
    nodes: tuple[Node, Node], spec: EnvSpec
) -> None:
    learner, actor = nodes
    run = Lockstep(base_config(["--method", "dqn"]))
    run.env.close()
    service = JoinService(learner, run.config, spec, "", 9, SharedCheckpoints([], "run"), Roster(), print)
    reporter = StatusReporter(learner, run.trainer, SampleClient(learner, Stop(), 1, spec, 32, 1), service, Console())
    published: list[object] = []
    actor.on(status_key(actor, "learner"), "counting", lambda key, message: published.append(message.fields["waiting"]))

    def publish_until(reached: Callable[[], object], waiting: str) -> None:
        deadline = time.monotonic() + 20
        while not reached():
            learner.publish_status(replace(reporter.publish(0.0), waiting=waiting))
            assert time.monotonic() < deadline
            time.sleep(0.05)

    publish_until(lambda: published, "the first")  # the subscription is known then
    before = len(published)
    for tick in range(1000):
        reporter.publish_members(100 + tick / 1000)
    publish_until(lambda: "the last" in published, "the last")
    between = published[before : published.index("the last")]
    assert 8 <= len(between) - between.count("the first") < 1.5 / MEMBERS_EVERY


def test_a_status_of_a_closed_session_is_dropped(endpoint: str) -> None:
    with Node(open_session((endpoint,)), "test", "actor", 7) as node:
        node.publish_status(ActorStatus(10, 8))
    node.publish_status(ActorStatus(10, 8))
