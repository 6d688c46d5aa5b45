"""Who may join, who is named when it goes, and when the dead are started again."""

import time
from pathlib import Path

import pytest
from msgspec.structs import replace
from samples import make_segment

from common.errors import JoinError
from common.messaging import wire
from common.messaging.joining import difference, join
from common.messaging.keys import join_key, replay_key
from common.messaging.messages.join import Join, Joined
from common.messaging.messages.limits import Limit, Limits, LimitsQuestion
from common.messaging.messages.sample import DrawRequest
from common.messaging.messages.stop import EndOfRun
from common.messaging.messages.weights import Current
from common.messaging.transport import Node, Refused, new_incarnation, open_session
from common.process.lifecycle import Stop
from common.settings.config import RunConfig
from common.types import EnvSpec
from deploy.supervisor import HEALTHY, RESTARTS, RestartPolicy
from learner.reception import Reception
from learner.roster import Roster
from learner.shared_epochs import SharedEpochs
from replay.core import ReplayCore
from replay.persistence.epochs import ReplayEpochs
from replay.service import ReplayService

REQUEST = Join("actor", 3, [])


def _receive(node: Node, spec: EnvSpec) -> None:
    Reception(node, RunConfig(run="test"), spec, "layout", run_id=9, epochs=SharedEpochs([], "run"), roster=Roster())


def test_another_protocol_is_refused_with_both_versions(
    nodes: tuple[Node, Node], spec: EnvSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, actor = nodes
    with monkeypatch.context() as patch:
        patch.setattr(wire, "PROTOCOL", 7)
        payload = REQUEST.encode("test")
        newer = EndOfRun.because("an answer of another protocol").encode("test")
    # Before the reception, so that who has joined knows of it too.
    learner.serve(learner.key("newer"), lambda message: newer)
    _receive(learner, spec)
    assert join(actor, Stop(), REQUEST, (), 5) is not None
    with pytest.raises(Refused, match="version 7; this process speaks 2"):
        actor.ask(join_key(actor, "actor"), payload)
    with pytest.raises(Refused, match="version 7; this process speaks 2"):
        actor.ask(actor.key("newer"), Current().encode("test"))


def test_another_run_is_named(nodes: tuple[Node, Node], endpoint: str) -> None:
    with (
        Node(open_session((), (endpoint,)), "other", "joining", 1) as stranger,
        pytest.raises(JoinError, match="no learner of run 'other' found at there within 1 s; there is run 'test'"),
    ):
        join(stranger, Stop(), REQUEST, ("there",), 1)


MINE = Joined(RunConfig(), EnvSpec("CartPole-v0", (4,), "float32", 1, 2), "abc", 0, [], 5, 0)


@pytest.mark.parametrize(
    ("theirs", "words"),
    [
        (replace(MINE, index=4, epoch=300, replay_endpoints=["x"]), None),
        (replace(MINE, config=RunConfig(checkpoint_every=7)), None),
        (replace(MINE, run_id=6), "run id here 5, the learner's 6"),
        (replace(MINE, layout="abd"), "network layout here abc, the learner's abd"),
        (replace(MINE, spec=replace(MINE.spec, num_actions=3)), "environment.num_actions here 2, the learner's 3"),
        (replace(MINE, config=RunConfig(seed=1)), "config.seed here 0, the learner's 1"),
    ],
)
def test_another_learner(theirs: Joined, words: str | None) -> None:
    assert difference(MINE, theirs) == words


def test_presence(nodes: tuple[Node, Node], endpoint: str) -> None:
    learner, _ = nodes
    changes: list[list[str]] = []
    learner.presence.on_change(lambda: changes.append(learner.presence.missing()))

    def wait_for(counts: dict[str, int]) -> None:
        deadline = time.monotonic() + 10
        while learner.presence.counts() != counts:
            assert time.monotonic() < deadline, learner.presence.counts()
            time.sleep(0.01)

    wait_for({"learner": 1, "actor": 1})
    with Node(open_session((), (endpoint,)), "test", "replay", 0xAB):
        wait_for({"learner": 1, "actor": 1, "replay": 1})
    wait_for({"learner": 1, "actor": 1})
    assert learner.presence.missing() == ["replay ab"]
    with Node(open_session((), (endpoint,)), "test", "replay", new_incarnation()):
        wait_for({"learner": 1, "actor": 1, "replay": 1})
        assert learner.presence.missing() == [], "another one has taken its place"
    assert ["replay ab"] in changes


def test_the_limiter_changes_while_the_run_goes_on(nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path) -> None:
    server, client = nodes
    config = RunConfig(run="test", total_steps=1000)
    core = ReplayCore(config, spec)
    ReplayService(server, core, ReplayEpochs(tmp_path, 5)).start()
    key = replay_key(client, "limits")
    for sequence in range(125):
        core.insert(make_segment(spec, sequence))
    request = DrawRequest(1, 0, 0, config.learner.batch_size, 0)
    drawn = client.ask(replay_key(client, "sample"), request.encode("test"))
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
    while policy.ended(now):
        assert policy.at is not None
        assert not policy.due(policy.at - 0.01)
        pauses.append(policy.at - now)
        now = policy.at
        assert policy.due(now)
        assert not policy.due(now)
    assert len(pauses) == RESTARTS
    assert pauses[:6] == pytest.approx([0.25, 0.5, 1, 2, 4, 4])
    assert policy.ended(now + HEALTHY), "a healthy spell, and the past is forgotten"
    assert policy.ends == 1
