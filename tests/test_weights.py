"""An actor's networks and acting role follow the learner's, over real sessions; a layout that differs is refused."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import zenoh
from msgspec.structs import replace as changed
from samples import await_service, until

from coop.actors.policy import EpsilonGreedy
from coop.actors.weights import WeightsFollower, make_policy
from coop.common.errors import JoinError, UsageError
from coop.common.messaging.keys import role_key, weights_key
from coop.common.messaging.messages.control import JoinReply
from coop.common.messaging.messages.weights import Role, Weights
from coop.common.messaging.timing import GRACE
from coop.common.messaging.transport import Node
from coop.common.messaging.wire import Message
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.settings.config import NetworkSettings, RunConfig
from coop.common.types import Array, EnvSpec
from coop.learner.agent import Agent
from coop.learner.broadcast import Broadcaster

CONFIG = RunConfig(method="coop", network=NetworkSettings(hidden=(8,)))


def own_policy(spec: EnvSpec) -> EpsilonGreedy:
    """Networks of the run's layout with parameters of their own."""
    first, second = (FlatNetwork(build_network("mlp", spec, (8,), seed=seed)) for seed in (7, 8))
    return EpsilonGreedy((first, second), spec, np.random.default_rng(0))


def refresh_until(follower: WeightsFollower, version: int, seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while follower.version != version:
        assert time.monotonic() < deadline, f"version {follower.version} instead of {version}"
        follower.refresh()
        time.sleep(0.01)


def assert_equal(policy: EpsilonGreedy, agent: Agent) -> None:
    for mine, theirs in zip(policy.networks, agent.networks, strict=True):
        np.testing.assert_array_equal(mine.snapshot(), theirs.snapshot())


def change(agent: Agent, number: int, version: int) -> None:
    """What an update does to the network that acts, as far as actors see it."""
    agent.networks[number].load(agent.networks[number].snapshot() + np.float32(1))
    agent.versions[number] = agent.updates = version


def followed(nodes: tuple[Node, Node], spec: EnvSpec) -> tuple[Agent, Broadcaster, EpsilonGreedy, WeightsFollower]:
    """An agent with its broadcasts, and a policy that has followed them so far."""
    learner, actor = nodes
    agent = Agent(CONFIG, spec)
    broadcaster = Broadcaster(learner, agent)
    policy = own_policy(spec)
    follower = WeightsFollower(actor, policy)
    refresh_until(follower, 0)
    return agent, broadcaster, policy, follower


def test_an_actor_follows_weights_and_role_through_swaps(nodes: tuple[Node, Node], spec: EnvSpec) -> None:
    learner, actor = nodes
    agent = Agent(CONFIG, spec)
    broadcaster = Broadcaster(learner, agent)
    policy = own_policy(spec)
    follower = WeightsFollower(actor, policy)
    assert not follower.ready
    assert follower.progress == (0, 0)
    refresh_until(follower, 0)  # asked for: the broadcast was before its time
    assert follower.ready
    assert policy.acting == 0
    assert_equal(policy, agent)
    for version in range(1, 7):
        acting = version % 2
        change(agent, acting, version)
        agent.acting = acting
        broadcaster.publish(env_step=10 * version, wait=True)
        refresh_until(follower, version)
        assert policy.acting == acting
        assert follower.progress == (version, 10 * version)
        assert_equal(policy, agent)


def test_a_broadcast_that_was_lost_is_asked_for(nodes: tuple[Node, Node], spec: EnvSpec) -> None:
    learner, _ = nodes
    agent, broadcaster, policy, follower = followed(nodes, spec)
    change(agent, 0, 5)
    publish, learner.publish = learner.publish, lambda key, payload: None  # type: ignore[method-assign]
    broadcaster.publish(wait=True)
    learner.publish = publish  # type: ignore[method-assign]
    began = time.monotonic()
    broadcaster.publish_role()  # says that there is a version 5
    refresh_until(follower, 5)
    assert time.monotonic() - began >= GRACE
    assert_equal(policy, agent)


def test_an_older_broadcast_that_comes_before_the_answer_is_not_followed_after_it(
    nodes: tuple[Node, Node], spec: EnvSpec
) -> None:
    learner, actor = nodes
    agent, key = Agent(CONFIG, spec), role_key(learner)
    policy = own_policy(spec)
    follower, heard = WeightsFollower(actor, policy), actor.latest(key)

    def answer(message: Message) -> bytearray:
        learner.publish(key, Role(1, (0, 0), 14, 0).encode(learner.run))
        until(lambda: heard.poll() is not None)
        return Role(2, (0, 0), 15, 0).encode(learner.run)

    for number, network in enumerate(agent.networks, 1):
        weights = Weights(number, 0, network.snapshot()).encode(learner.run)
        learner.serve(weights_key(learner, number), lambda message, weights=weights: weights)  # type: ignore[misc]
    learner.serve(key, answer)
    await_service(actor, key)
    while not follower.ready:
        follower.fetch()
    assert (policy.acting, follower.progress) == (1, (15, 0))
    follower.refresh()
    assert (policy.acting, follower.progress) == (1, (15, 0))


@pytest.mark.parametrize(("hidden", "at_once"), [(513, True), (514, False)])
def test_small_networks_are_sent_at_once(nodes: tuple[Node, Node], spec: EnvSpec, hidden: int, at_once: bool) -> None:
    """Those below 1 MiB for all actors, here one; others by a thread."""
    learner, _ = nodes
    agent = Agent(replace(CONFIG, network=NetworkSettings(hidden=(hidden, 503))), spec)
    assert (agent.networks[0].snapshot().nbytes < 1 << 20) == at_once
    broadcaster, publish, by = Broadcaster(learner, agent), learner.publish, set[int]()

    def noted(key: str, payload: bytearray) -> None:
        by.add(threading.get_ident())
        publish(key, payload)

    learner.publish = noted  # type: ignore[method-assign]
    until(lambda: learner.presence.counts().get("actor") == 1)
    change(agent, 0, 1)
    broadcaster.publish()
    broadcaster.close()
    assert (by == {threading.get_ident()}) == at_once
    assert len(by) == 1


def test_broadcasts_that_take_long_hold_up_no_update(
    nodes: tuple[Node, Node], spec: EnvSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What changes meanwhile follows in one broadcast, and no role names weights that have not been sent."""
    monkeypatch.setattr("coop.learner.broadcast.SMALL", 0)
    learner, _ = nodes
    agent, broadcaster, policy, follower = followed(nodes, spec)
    publish, gate, sent = learner.publish, threading.Event(), []

    def slow(key: str, payload: bytearray) -> None:
        sent.append(key)
        gate.wait(20)
        publish(key, payload)

    learner.publish = slow  # type: ignore[method-assign]
    for version in (1, 2, 3):
        change(agent, 0, version)
        broadcaster.publish(env_step=version)
        assert broadcaster.due == (version > 1)
        broadcaster.publish_role()
    gate.set()
    while broadcaster.due:
        broadcaster.publish(env_step=4)
        time.sleep(0.001)
    refresh_until(follower, 3)
    assert sent == 2 * [weights_key(learner, 1), role_key(learner)]
    assert_equal(policy, agent)
    assert follower.progress == (3, 4)


def test_an_actor_that_has_everything_asks_for_nothing(
    nodes: tuple[Node, Node], spec: EnvSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, actor = nodes
    Broadcaster(learner, Agent(CONFIG, spec))
    follower = WeightsFollower(actor, own_policy(spec))
    refresh_until(follower, 0)
    until(lambda: follower.ready)
    monkeypatch.setattr("coop.actors.weights.GRACE", 0.02)
    monkeypatch.setattr(follower, "fetching", lambda: pytest.fail("asked"))
    end = time.monotonic() + 0.06
    while time.monotonic() < end:
        follower.refresh()


class Answering:
    """A learner that answers with the same weights and role; asked: the keys by which it was."""

    def __init__(self, learner: Node, versions: tuple[int, int], role: Role, flat: Array) -> None:
        self.asked: list[str] = []
        self.keys = [weights_key(learner, 1), weights_key(learner, 2), role_key(learner)]
        weights = [Weights(number, versions[number - 1], flat).encode(learner.run) for number in (1, 2)]
        for key, answer in zip(self.keys, [*weights, role.encode(learner.run)], strict=True):
            learner.serve(key, lambda _, key=key, answer=answer: self._answer(key, answer))  # type: ignore[misc]

    def _answer(self, key: str, answer: bytearray) -> bytearray:
        self.asked.append(key)
        return answer


def test_what_a_role_names_and_nobody_sent_is_asked_for_once_in_a_while(
    nodes: tuple[Node, Node], spec: EnvSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, actor = nodes
    policy = own_policy(spec)
    answering = Answering(learner, (3, 3), Role(1, (4, 3), 4, 0), policy.networks[0].snapshot())
    for key in answering.keys:
        await_service(actor, key)
    follower, now = WeightsFollower(actor, policy), 100.0
    monkeypatch.setattr(actor, "now", lambda: now)
    assert follower.fetch() is True
    assert (follower.ready, follower.settled, follower.version) == (True, False, 3)
    for _ in range(2):
        answering.asked.clear()
        follower.refresh()
        now += GRACE / 2
        follower.refresh()
        assert answering.asked == []
        now += GRACE / 2
        follower.refresh()
        assert answering.asked == answering.keys


@pytest.mark.parametrize("broadcast", [3, 5])
def test_the_newest_of_an_answer_and_a_broadcast_meanwhile_is_loaded(
    broadcast: int, nodes: tuple[Node, Node], spec: EnvSpec
) -> None:
    learner, actor = nodes
    policy = own_policy(spec)
    flats = {version: policy.networks[0].snapshot() + np.float32(version) for version in (3, 4, 5)}
    follower, key = WeightsFollower(actor, policy), weights_key(learner, 1)
    heard = actor.latest(key)

    def answer(message: Message) -> bytearray:
        learner.publish(key, Weights(1, broadcast, flats[broadcast]).encode(learner.run))
        until(lambda: heard.poll() is not None)
        return Weights(1, 4, flats[4]).encode(learner.run)

    learner.serve(key, answer)
    await_service(actor, key)
    assert follower.fetch() is False, "nobody answers for the second network"
    assert follower.version == max(broadcast, 4)
    np.testing.assert_array_equal(policy.networks[0].snapshot(), flats[max(broadcast, 4)])
    follower.refresh()
    assert follower.version == max(broadcast, 4)


def test_a_broadcast_that_is_none_changes_nothing_and_is_counted(
    nodes: tuple[Node, Node], spec: EnvSpec, capsys: pytest.CaptureFixture[str]
) -> None:
    learner, actor = nodes
    agent = Agent(CONFIG, spec)
    Broadcaster(learner, agent)
    policy = own_policy(spec)
    follower = WeightsFollower(actor, policy)
    refresh_until(follower, 0)
    learner.publish(role_key(learner), Role(2, (9, 9), 9).encode("test")[:20])
    learner.publish(weights_key(learner, 1), Role(2, (9, 9), 9).encode("test"))
    deadline = time.monotonic() + 10
    while actor.bad_messages < 2:
        assert time.monotonic() < deadline
        follower.refresh()
        time.sleep(0.01)
    learner.publish(role_key(learner), Weights(1, 9, policy.networks[0].snapshot()).encode("test"))
    while actor.bad_messages < 3:
        assert time.monotonic() < deadline
        follower.refresh()
        time.sleep(0.01)
    assert policy.acting == 0
    assert_equal(policy, agent)
    refused = capsys.readouterr().out
    assert f"refused a message at {actor.key('role')}: " in refused
    assert f"refused a message at {actor.key('weights')}: " in refused


@pytest.mark.parametrize("silent", ["weights", "role"])
def test_an_actor_does_not_wait_long_for_a_learner_that_is_silent(
    silent: str, nodes: tuple[Node, Node], spec: EnvSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coop.actors.weights.ANSWER_TIMEOUT", 0.1)
    learner, actor = nodes
    policy = own_policy(spec)
    follower = WeightsFollower(actor, policy)
    flat = policy.networks[0].snapshot()
    answers = {weights_key(learner, number): Weights(number, 4, flat).encode("test") for number in (1, 2)}
    answers[role_key(learner)] = Role(2, (4, 4), 4).encode("test")
    unanswered = weights_key(learner, 2) if silent == "weights" else role_key(learner)
    for key in answers.keys() - {unanswered}:
        learner.serve(key, lambda _, answer=answers[key]: answer)  # type: ignore[misc]
    mute = learner.session.declare_queryable(unanswered, zenoh.handlers.FifoChannel(8), complete=True)
    for key in answers:
        await_service(actor, key)
    began = time.monotonic()
    follower.refresh()
    assert time.monotonic() - began < 5
    mute.undeclare()
    assert policy.acting == 0
    assert follower.version == 4
    follower.refresh()
    assert not follower.ready, "without the role it does not know which network acts"


def test_a_layout_that_differs_is_refused(spec: EnvSpec) -> None:
    layout = Agent(CONFIG, spec).networks[0].layout_digest()
    reply = JoinReply(CONFIG, spec, layout, 0, [], 5, 0)
    policy = make_policy(reply, (), np.random.default_rng(0))
    first, second = policy.networks
    assert first.layout_digest() == second.layout_digest() == layout
    with pytest.raises(JoinError, match=f"network layout here {layout}, the learner's 0123"):
        make_policy(changed(reply, layout="0123"), (), np.random.default_rng(0))
    wider = replace(CONFIG, network=NetworkSettings(hidden=(9,)))
    with pytest.raises(JoinError, match="network layout here"):
        make_policy(changed(reply, config=wider), (), np.random.default_rng(0))


def test_a_policy_has_the_generator_and_the_device_that_it_is_given(spec: EnvSpec) -> None:
    reply = JoinReply(CONFIG, spec, Agent(CONFIG, spec).networks[0].layout_digest(), 0, [], 5, 0)
    policy = make_policy(reply, (), np.random.default_rng(3))
    obs = np.zeros((40, *spec.obs_shape), spec.frame_dtype)
    expected = EpsilonGreedy(policy.networks, spec, np.random.default_rng(3)).act(obs, 0.5)
    np.testing.assert_array_equal(policy.act(obs, 0.5), expected)
    with pytest.raises(RuntimeError, match="nowhere"):
        make_policy(reply, (), np.random.default_rng(3), "nowhere")


def test_a_run_of_a_module_that_may_not_be_imported_here_is_refused(spec: EnvSpec) -> None:
    config = replace(CONFIG, network=NetworkSettings(kind="elsewhere.nets:Net"))
    reply = JoinReply(config, spec, "0123", 0, [], 5, 0)
    with pytest.raises(JoinError, match=r"^network\.kind = 'elsewhere\.nets:Net': this process may not import"):
        make_policy(reply, ("other",), np.random.default_rng(0))
    with pytest.raises(UsageError, match="elsewhere"):  # allowed, but there is none
        make_policy(reply, ("elsewhere",), np.random.default_rng(0))
