"""The replay service behind real Zenoh sessions: receipts, reasons, duplicates, bad messages, snapshots, restarts."""

import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from samples import await_service, make_segment, until

from coop.common.bounds import MAX_COUNT
from coop.common.errors import RunError
from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.keys import replay_key
from coop.common.messaging.links import locators
from coop.common.messaging.members import ROUTE
from coop.common.messaging.messages.answers import Ack, Retry
from coop.common.messaging.messages.control import Snapshot, Written
from coop.common.messaging.messages.insert import encode_segment
from coop.common.messaging.messages.sample import encode_request
from coop.common.messaging.messages.status import ReplayStats, StatsQuestion
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.session import open_session
from coop.common.messaging.timing import ASK_TIMEOUT
from coop.common.messaging.transport import NoAnswer, Node, Refused, new_incarnation
from coop.common.process.lifecycle import Stop
from coop.common.settings.config import LearnerSettings, ReplaySettings, RunConfig
from coop.common.transitions import DrawRequest
from coop.common.types import EnvSpec
from coop.replay.core import ReplayCore, RetryLater
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.service import ReplayService

CONFIG = RunConfig(
    run="test",
    total_steps=1000,
    learner=LearnerSettings(batch_size=4),
    replay=ReplaySettings(capacity=100, learning_starts=8, tolerance=8.0),
)


def _serve(node: Node, core: ReplayCore, folder: Path, asker: Node | None = None) -> ReplayService:
    """A service that has started, and that `asker` has heard of."""
    service = ReplayService(node, core, ReplayCheckpoints(folder, 5))
    service.start()
    if asker is not None:
        await_service(asker, replay_key(asker, "snapshot"))  # the last one that it declares
    return service


def test_receipts_duplicates_and_reasons(nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path) -> None:
    server, client = nodes
    core = ReplayCore(CONFIG, spec)
    service = _serve(server, core, tmp_path, client)
    key = replay_key(client, "insert")

    sample = encode_request("test", DrawRequest(1, 0, 0, 4, 0))
    began = time.monotonic()
    reply = client.ask(replay_key(client, "sample"), sample)
    assert 0.5 < time.monotonic() - began < 4
    assert Retry.decode(reply).reason == "waiting for 8 transitions, have 0"

    first = encode_segment("test", make_segment(spec, 0, terminated=np.arange(4) == 3))
    assert Ack.decode(client.ask(key, first)).inserted == 4
    assert Ack.decode(client.ask(key, first)).inserted == 4, "a retry is acknowledged and not taken twice"
    for sequence in range(1, 5):
        client.ask(key, encode_segment("test", make_segment(spec, sequence)))
    reply = client.ask(key, encode_segment("test", make_segment(spec, 5)))
    assert Retry.decode(reply).reason == "inserts are 12 steps ahead of updates"

    drawn = client.ask(replay_key(client, "sample"), sample)
    again = client.ask(replay_key(client, "sample"), sample)
    for name in ("ids", "frames", "obs_index"):
        np.testing.assert_array_equal(drawn.arrays[name], again.arrays[name])
    assert (drawn.fields["size"], drawn.fields["terminal"]) == (20, 1)
    stats = service.stats()
    assert (stats.inserted, stats.drawn, stats.duplicates, stats.lost, stats.episodes) == (20, 1, 1, 0, 5)
    question = StatsQuestion().encode("test")
    asked = ReplayStats.decode(client.ask(replay_key(client, "stats"), question))
    assert asked.inserted == 20


def test_a_waiting_insert_goes_in_when_updates_catch_up(
    nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path
) -> None:
    server, client = nodes
    _serve(server, ReplayCore(CONFIG, spec), tmp_path, client)
    for sequence in range(5):
        client.ask(replay_key(client, "insert"), encode_segment("test", make_segment(spec, sequence)))
    payload = encode_segment("test", make_segment(spec, 5))
    pending = client.begin(replay_key(client, "insert"), payload)
    for number in range(4):
        client.ask(replay_key(client, "sample"), encode_request("test", DrawRequest(1, number, 0, 4, 0)))
    assert Ack.decode(pending.wait()).inserted == 24


def test_bad_messages_change_nothing(nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path) -> None:
    server, client = nodes
    service = _serve(server, ReplayCore(CONFIG, spec), tmp_path, client)
    key = replay_key(client, "insert")
    wrong = make_segment(spec, actions=np.full(4, 9, np.int32))
    before = service.stats()
    for payload, field in (
        (bytearray(b"nonsense, but long enough"), "magic"),
        (bytearray(), "payload"),
        (encode_segment("test", wrong), "arrays.actions"),
        (encode_segment("other", make_segment(spec)), "run"),
    ):
        with pytest.raises(Refused, match=field):
            client.ask(key, payload)
    assert service.stats().bad_messages == before.bad_messages + 4
    assert service.stats().inserted == 0
    assert Ack.decode(client.ask(key, encode_segment("test", make_segment(spec)))).inserted == 4


def test_snapshot_on_disk(nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path) -> None:
    server, client = nodes
    core = ReplayCore(CONFIG, spec)
    _serve(server, core, tmp_path, client)
    client.ask(replay_key(client, "insert"), encode_segment("test", make_segment(spec)))
    key = replay_key(client, "snapshot")
    client.ask(key, Snapshot(12, [], 1, 0).encode("test"))
    while client.ask(key, Written(12).encode("test")).kind == "retry":
        pass
    folder = tmp_path / "checkpoints" / "12" / "replay"
    assert np.load(folder / "rewards.npy").tolist() == [0, 1, 2, 3]
    assert np.load(folder / "frames.npy").shape == (5, 4)
    with pytest.raises(Refused, match="checkpoint 13 was not begun"):
        client.ask(key, Written(13).encode("test"))


def test_lost_counts_receipts_without_transitions(spec: EnvSpec) -> None:
    core = ReplayCore(CONFIG, spec)
    assert not isinstance(core.insert(make_segment(spec, 0)), RetryLater)
    assert core.lost == 0
    core.insert(make_segment(spec, 2, acked=8))
    assert core.lost == 0, "4 taken then, 4 more now"
    core.insert(make_segment(spec, 3, acked=16))
    assert core.lost == 4


def test_a_liar_can_t_make_up_more_losses_than_the_run_has_steps(
    nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path
) -> None:
    server, client = nodes
    _serve(server, ReplayCore(CONFIG, spec), tmp_path, client)
    for incarnation in range(3):
        payload = encode_segment("test", make_segment(spec, incarnation=incarnation, acked=MAX_COUNT))
        client.ask(replay_key(client, "insert"), payload)
    payload = encode_segment("test", make_segment(spec, incarnation=9, acked=2**63 - 1))
    with pytest.raises(Refused, match="acked"):
        client.ask(replay_key(client, "insert"), payload)
    stats = ReplayStats.decode(client.ask(replay_key(client, "stats"), StatsQuestion().encode("test")))
    assert stats.lost == CONFIG.total_steps


def test_clients_survive_a_service_that_goes_away(endpoint: str, spec: EnvSpec, tmp_path: Path) -> None:
    core, stop, sent = ReplayCore(CONFIG, spec), Stop(), 12
    first = Node(open_session((endpoint,)), "test", "replay", new_incarnation())
    _serve(first, core, tmp_path)
    with Node(open_session((), (endpoint,)), "test", "actor", new_incarnation()) as client:
        inserts = InsertClient(client, stop, window=2)
        samples = SampleClient(client, stop, 1, spec, batch_size=4, prefetch=2)
        outcome: list[bool] = []

        def act() -> None:
            outcome.extend(inserts.submit(make_segment(spec, number, acked=inserts.acked)) for number in range(sent))
            outcome.append(inserts.drain())

        thread = threading.Thread(target=act)
        thread.start()
        episodes, batches = [], 0
        try:
            while batches < 8:
                if (got := samples.next()) is not None:
                    batches += 1
                    episodes += got[1].episodes
            first.close()
            time.sleep(0.3)
            second = Node(open_session((endpoint,)), "test", "replay", new_incarnation())
            _serve(second, core, tmp_path)
            while batches < 40:
                if (got := samples.next()) is not None:
                    batches += 1
                    episodes += got[1].episodes
            thread.join(20)
            assert not thread.is_alive()
        finally:
            stop.set("test over")
            thread.join()
        second.close()
    assert outcome == [True] * (sent + 1)
    assert core.table.inserted == 4 * sent
    assert inserts.acked == 4 * sent
    assert core.lost == 0
    assert [record.env_step for record in episodes] == sorted({record.env_step for record in episodes})


def test_segments_wait_behind_their_window_without_being_sent_again(
    nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path
) -> None:
    server, client = nodes
    service = _serve(server, ReplayCore(CONFIG, spec), tmp_path, client)
    reasons: list[str] = []
    inserts = InsertClient(client, Stop(), window=16, on_wait=lambda: reasons.append(inserts.waiting))
    for number in range(16):  # the limiter lets 5 in, then one for every 4 draws
        assert inserts.submit(make_segment(spec, number, acked=inserts.acked))
    waiter = threading.Thread(target=inserts.drain)
    waiter.start()
    began = time.monotonic()
    for number in range(44):
        client.ask(replay_key(client, "sample"), encode_request("test", DrawRequest(1, number, 0, 4, 0)))
        time.sleep(0.14)
    waiter.join(5)
    assert time.monotonic() - began > ASK_TIMEOUT, "the last one waited longer than an ordinary question may"
    assert inserts.acked == 16 * 4
    assert service.stats().duplicates == 0
    assert len(reasons) > 50, "and whoever looks is told meanwhile"


def test_actors_share_what_may_be_in_flight(
    nodes: tuple[Node, Node], endpoint: str, spec: EnvSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coop.replay.service.IN_FLIGHT", 5)
    server, client = nodes
    _serve(server, ReplayCore(CONFIG, spec), tmp_path, client)

    def permitted(sequence: int) -> int:
        payload = encode_segment("test", make_segment(spec, sequence))
        return Ack.decode(client.ask(replay_key(client, "insert"), payload)).window

    assert permitted(0) == 5, "one actor has all of it"
    with ExitStack() as stack:
        for number in range(1, 8):
            stack.enter_context(Node(open_session((), (endpoint,)), "test", ROUTE, number))
            until(lambda number=number: server.presence.counts().get(ROUTE) == number)
            assert permitted(0) == max(1, 5 // number), "but no actor has none"
    until(lambda: ROUTE not in server.presence.counts())

    stop = Stop()
    inserts = InsertClient(client, stop, window=16)
    for number in range(1, 10):  # the limiter lets 4 more in
        assert inserts.submit(make_segment(spec, number))
    threading.Timer(0.3, stop.set, ("enough",)).start()
    assert not inserts.submit(make_segment(spec, 10)), "5 are in flight"


def test_a_stop_ends_the_waiting(endpoint: str, spec: EnvSpec) -> None:
    stop = Stop()
    with Node(open_session((endpoint,)), "test", "actor", new_incarnation()) as client:
        reasons: list[str] = []
        inserts = InsertClient(client, stop, window=4, on_wait=lambda: reasons.append(inserts.waiting))
        threading.Timer(0.3, stop.set, ("enough",)).start()
        assert inserts.submit(make_segment(spec, 0))
        assert not inserts.submit(make_segment(spec, 1)), "until it is acknowledged, the first one goes alone"
        assert inserts.waiting == "the replay service does not answer"
        assert reasons.count(inserts.waiting) > 1, "the reason is told again and again"
        with pytest.raises(NoAnswer):
            client.ask(replay_key(client, "stats"), StatsQuestion().encode("test"))


def test_a_port_in_use_is_named() -> None:
    with (
        Node(open_session(("tcp/127.0.0.1:0",)), "test", "replay", new_incarnation()) as node,
        pytest.raises(RunError, match="can't listen on"),
    ):
        open_session(tuple(locators(node.session)))


def test_a_learner_sets_priorities_with_its_next_draw(nodes: tuple[Node, Node], spec: EnvSpec, tmp_path: Path) -> None:
    server, client = nodes
    replay = replace(CONFIG.replay, sampling="prioritized", priority_exponent=1.0, tolerance=200.0)
    core = ReplayCore(replace(CONFIG, replay=replay), spec)
    _serve(server, core, tmp_path, client)
    for sequence in range(15):
        client.ask(replay_key(client, "insert"), encode_segment("test", make_segment(spec, sequence)))
    samples = SampleClient(client, Stop(), 1, spec, 4, 2)
    chosen = -1
    for number in range(12):
        got = None
        while got is None:
            got = samples.next()
        batch = got[0]
        if number == 0:
            chosen = int(batch.ids[0])
        samples.prioritise(batch.ids, np.where(batch.ids == chosen, 1e6, 1e-3).astype(np.float32))
        if number > 3:  # two requests were under way before the first priorities were known
            assert (batch.ids == chosen).all()
