"""The learner's mirror of the table's frames: each frame is sent once, and no fault makes a batch hold a wrong one."""

import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import await_service, make_segment

from coop.common.messaging import wire
from coop.common.messaging.conversation import drive_held
from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.keys import replay_key
from coop.common.messaging.links import locators
from coop.common.messaging.messages.sample import NAMED, NamedBatch, NamedBatchReader, encode_request
from coop.common.messaging.mirror import FIRST_SLOTS, FrameMirror
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import NoAnswer, Node, Refused, new_incarnation
from coop.common.messaging.wire import Message
from coop.common.process.lifecycle import Stop
from coop.common.process.limits import MemoryLimit
from coop.common.process.memory import GrowingRows
from coop.common.settings.capacity import MIRROR_SHARE, estimated_bytes, mirror_slots, mirrors
from coop.common.settings.config import LearnerSettings, ReplaySettings, RunConfig
from coop.common.settings.effects import without_effect
from coop.common.settings.resuming import check_resumed
from coop.common.transitions import IN_BATCH, Batch, DrawRequest, Segment
from coop.common.types import EnvSpec
from coop.learner.device_mirror import DeviceMirror
from coop.replay.core import ReplayCore, Reply
from coop.replay.mirrored import MirroredFrames
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.service import ReplayService

NUMBERS = EnvSpec("numbers", (2,), "float32", 1, 2)  # frame n holds n, and is the observation of transition n
CAPACITY = 12
CONFIG = RunConfig(
    run="test",
    total_steps=100_000,
    learner=LearnerSettings(batch_size=4),
    replay=ReplaySettings(capacity=CAPACITY, learning_starts=4, tolerance=1e9),
)
MIRRORS: dict[str, Callable[[EnvSpec, int], FrameMirror]] = {
    "host": FrameMirror,
    "device": lambda spec, slots: DeviceMirror(spec, slots, torch.device("cpu")),
}
TRIES = 8  # calls within which a batch must arrive once nothing fails


def _ended() -> Stop:
    """Pauses end at once where a stop has been requested."""
    stop = Stop()
    stop.set("no pauses")
    return stop


# ----------------------------------------------------------------------------------------------------------------------
# Both halves of the protocol, the real client and the real service's answers, joined by a network that is made up.


def _make_service(core: ReplayCore) -> ReplayService:
    return ReplayService(SimpleNamespace(run="test", now=time.monotonic), core, None)  # type: ignore[arg-type]


@dataclass
class _Network:
    """Carries requests to the last of the services, or late ones to an earlier one, with the faults that are drawn.

    carried: how often the frame of each number was sent, by table. answered: the kinds of answers.
    """

    services: list[ReplayService]
    draw_fault: Callable[[], str] = lambda: "none"
    carried: Counter[tuple[int, int]] = field(default_factory=Counter)
    requests: int = 0
    run: str = "test"

    def key(self, *parts: str) -> str:
        return "/".join(parts)

    def begin(self, key: str, payload: bytearray) -> "_Query":
        self.requests += 1
        return _Query(self, bytes(payload), self.draw_fault())

    def answer(self, payload: bytes, service: int = -1) -> Message:
        target = self.services[service]
        reply = bytes(drive_held(target._sample(wire.decode(payload)), threading.Condition()))
        message = wire.decode(reply)
        if message.kind == NAMED:
            numbers = message.arrays["numbers"][message.arrays["carried"]].tolist()
            self.carried.update((message.fields["table"], number) for number in numbers)
        return message


class _Query:
    """A query in flight, which meets a fault."""

    def __init__(self, network: _Network, payload: bytes, fault: str) -> None:
        self._network, self._payload, self._fault = network, payload, fault
        at_once = fault != "late" and fault != "lost request"
        earlier = 0 if fault in EARLIER else -1
        self._answers = [network.answer(payload, earlier)] if at_once else []
        if fault.startswith("twice") or fault == "both services":
            self._answers.append(network.answer(payload))

    def settle(self) -> None:
        """Nothing is awaited."""

    def ready(self) -> Message:
        if self._fault.startswith("lost"):
            raise NoAnswer("lost")
        if self._fault == "late":  # it overtakes none: later requests were answered before it
            return self._network.answer(self._payload)
        return self._answers[-1 if self._fault == "twice, second" else 0]


EARLIER = ("an earlier service", "both services")  # and its answer is the one that arrives
FAULTS = ("none", "none", "none", "lost request", "lost answer", "late", "twice, first", "twice, second")


def _insert(core: ReplayCore, sequence: int) -> None:
    assert core.insert(make_segment(NUMBERS, sequence)) == 4 * sequence + 4


def _restored(core: ReplayCore) -> ReplayCore:
    """A core as a restarted service has it from a checkpoint: the same draws to repeat, and frames in other slots."""
    state, episodes, (meta, arrays, frames), replies = core.snapshot(0)
    with frames:
        again = ReplayCore(CONFIG, NUMBERS)
        again.restore(state, episodes, meta, {**arrays, "frames": frames.read()}, replies)
    return again


def _assert_right(batch: Batch) -> None:
    for index, offset in ((batch.obs_index, 0), (batch.next_index, 1)):
        np.testing.assert_array_equal(batch.frames[index[:, 0], 1], batch.ids + offset)


def _batch(client: SampleClient) -> Batch:
    for _ in range(TRIES):
        if (got := client.next()) is not None:
            return got[0]
    raise AssertionError(f"no batch in {TRIES} tries: {client.waiting}")


def _client(
    node: Any, number: int, first: int, prefetch: int, slots: int, spec: EnvSpec = NUMBERS, place: str = "host"
) -> SampleClient:
    mirror = MIRRORS[place](spec, slots)
    return SampleClient(node, _ended(), number, spec, 4, prefetch, first, mirror=mirror)


@settings(max_examples=100)
@given(
    data=st.data(),
    prefetch=st.integers(1, 6),
    slots=st.sampled_from((1, 5, 1000)),
    place=st.sampled_from(("host", "device")),
)
def test_no_fault_makes_a_batch_wrong_or_loses_one(data: st.DataObject, prefetch: int, slots: int, place: str) -> None:
    core = ReplayCore(CONFIG, NUMBERS)
    for inserted in range(3):
        _insert(core, inserted)
    network = _Network([_make_service(core)])
    learner, done, inserted = 1, 0, 3
    client = _client(network, learner, done, prefetch, slots, place=place)

    def fault() -> str:
        earlier = EARLIER if len(network.services) > 1 else ()
        return data.draw(st.sampled_from((*FAULTS, *earlier)))

    network.draw_fault = fault
    events = st.sampled_from(("draw", "draw", "draw", "draw", "insert", "restart the service", "restart the learner"))
    for event in data.draw(st.lists(events, max_size=40)):
        if event == "insert":
            _insert(core, inserted)
            inserted += 1
        elif event == "restart the service":
            core = _restored(core)
            network.services = [network.services[-1], _make_service(core)]  # the old one may yet answer
        elif event == "restart the learner":
            learner += 1
            client = _client(network, learner, done, prefetch, slots, place=place)
        elif (got := client.next()) is not None:
            batch, drawn = got
            assert drawn.sequence == done
            _assert_right(batch)
            done += 1
    network.draw_fault = lambda: "none"
    for _ in range(3):
        with suppress(AssertionError):  # answers of before may still have to be asked for again
            _batch(client)
    for _ in range(10):
        _assert_right(_batch(client))


def test_two_services_that_answer_in_turn_confuse_nobody() -> None:
    """The answers of each build on frames of its own that the learner has had to forget, or that it never got."""
    core, tables = ReplayCore(CONFIG, NUMBERS), []
    for sequence in range(6):
        _insert(core, sequence)
        if sequence > 3:
            tables.append(_restored(core))  # with other frames in the same slots, under the same numbers
    faults = cycle(("none", "both services", "none", "none", "an earlier service", "none", "none"))
    network = _Network([_make_service(each) for each in tables], lambda: next(faults))
    client = _client(network, 1, 0, 4, 1000)
    for number in range(100):
        while (got := client.next()) is None:
            pass
        assert got[1].sequence == number
        _assert_right(got[0])


def test_a_mirror_that_had_to_be_emptied_fills_without_further_questions() -> None:
    core = ReplayCore(replace(CONFIG, replay=replace(CONFIG.replay, capacity=400)), NUMBERS)
    for sequence in range(100):
        _insert(core, sequence)
    fault = "none"
    network = _Network([_make_service(core), _make_service(core)], lambda: fault)  # one core, but two tables' names
    client = _client(network, 1, 0, 1, 1000)
    for _ in range(100):
        _batch(client)
    assert network.requests == 100
    fault = "an earlier service"
    _batch(client)
    fault = "none"
    for _ in range(100):
        _assert_right(_batch(client))
    assert network.requests <= 203


def test_without_faults_each_frame_is_sent_once_to_each_learner() -> None:
    core = ReplayCore(CONFIG, NUMBERS)
    network = _Network([_make_service(core)])
    for learner in (1, 2):
        client = _client(network, learner, core.drawn, 4, 1000)
        network.carried.clear()
        begin = core.table.inserted // 4
        for sequence in range(begin, begin + 30):
            _insert(core, sequence)
            for _ in range(4):
                _assert_right(_batch(client))
        assert set(network.carried.values()) == {1}
        assert len(network.carried) > 60, "and most of them were needed"


def test_a_draw_that_is_answered_again_brings_all_its_frames() -> None:
    core = ReplayCore(CONFIG, NUMBERS)
    for sequence in range(3):
        _insert(core, sequence)
    network = _Network([_make_service(core)])
    request = bytes(encode_request("test", DrawRequest(1, 0, 0, 4, 0, None, 1, 1000, 3)))
    read = NamedBatchReader(NUMBERS)
    first, again = (read(network.answer(request))[1] for _ in range(2))
    assert [len(batch.carried) for batch in again] == [len(batch.slots) for batch in again]
    assert sum(len(batch.carried) for batch in first) < sum(len(batch.carried) for batch in again)
    for one, other in zip(first, again, strict=True):
        assert one.columns.keys() == other.columns.keys()
        for name, column in {**one.columns, "slots": one.slots, "numbers": one.numbers}.items():
            np.testing.assert_array_equal(
                column, {**other.columns, "slots": other.slots, "numbers": other.numbers}[name]
            )


def test_several_draws_are_asked_for_where_none_must_wait() -> None:
    core = ReplayCore(replace(CONFIG, replay=replace(CONFIG.replay, tolerance=40.0)), NUMBERS)
    for sequence in range(5):
        _insert(core, sequence)
    network = _Network([_make_service(core)])
    client = _client(network, 1, 0, 8, 1000)
    for _ in range(8):
        _batch(client)
    assert network.requests > 10, "one by one at first, when every answer brings many frames"
    for _ in range(8):
        _batch(client)
    before = network.requests
    for _ in range(12):
        _batch(client)
    assert network.requests == before + 3, "and then four at once"
    # Six more are admitted where eight were: the client hears of it when it gets two of four.
    drawn = core.drawn
    core.limit(core.limiter.changed(20, drawn, ratio=1.0, tolerance=6.0))
    for _ in range(drawn + 6 - 28):
        _batch(client)
    assert core.drawn == drawn + 6
    assert client.next() is None
    assert client.waiting == "updates are 6 ahead of inserts"
    _insert(core, 5)
    for number in range(drawn + 6, drawn + 10):
        while (got := client.next()) is None:
            pass
        assert got[1].sequence == number


def test_the_first_answer_with_too_many_episodes_brings_one_batch() -> None:
    core = ReplayCore(replace(CONFIG, replay=replace(CONFIG.replay, capacity=5000)), NUMBERS)
    for sequence in range(1010):
        _insert(core, sequence)
    first = core.draws(DrawRequest(1, 0, 0, 4, 0, draws=3))
    assert isinstance(first, list)
    assert [len(drawn.episodes) for _, drawn in first] == [1000]
    later = core.draws(DrawRequest(1, 1, 0, 4, 1000, draws=3))
    assert isinstance(later, list)
    assert [(drawn.sequence, len(drawn.episodes)) for _, drawn in later] == [(1, 10), (2, 0), (3, 0)]


# ----------------------------------------------------------------------------------------------------------------------
# The mirror by itself.

PICTURES = EnvSpec("pictures", (3, 2), "uint8", 2, 2)


def _named(slots: list[int], numbers: list[int], carried: list[int], frames: np.ndarray[Any, Any]) -> NamedBatch:
    columns = {name: np.zeros(len(slots), column.dtype) for name, column in IN_BATCH.items()}
    columns["obs_index"] = columns["next_index"] = np.arange(len(slots), dtype=np.int32)[:, None]
    return NamedBatch(
        7, "", np.array(slots, np.int32), np.array(numbers, np.int64), np.array(carried, np.intp), frames, columns
    )


def _shown(batch: Batch | None) -> list[Any]:
    """The frames of a batch from `_named`, in their order."""
    assert batch is not None
    frames = batch.frames[batch.obs_index[:, 0]]
    assert str(frames.dtype).removeprefix("torch.") == "uint8"
    shown: list[Any] = frames.tolist()
    return shown


def _pictures(*numbers: int) -> np.ndarray[Any, Any]:
    return np.array(numbers, np.uint8)[:, None, None] + np.zeros((3, 2), np.uint8)


def _write(mirror: FrameMirror, table: int, slots: list[int], numbers: list[int]) -> None:
    mirror.write(table, np.array(slots, np.int32), np.array(numbers, np.int64), _pictures(*numbers))


@pytest.mark.parametrize("place", MIRRORS)
def test_a_frame_is_read_only_by_its_number(place: str) -> None:
    mirror = MIRRORS[place](PICTURES, 10_000)
    none = _pictures()
    assert mirror.read(_named([0], [1], [], none)) is None, "it holds nothing yet"
    _write(mirror, 7, [3], [11])
    _write(mirror, 7, [5 * FIRST_SLOTS], [12])
    read = mirror.read(_named([5 * FIRST_SLOTS, 3, 3], [12, 11, 11], [], none))
    assert _shown(read) == _pictures(12, 11, 11).tolist()
    for slots, numbers in (([3], [12]), ([4], [11]), ([3, 9999], [11, 12]), ([3, 2**31 - 1], [11, 13])):
        assert mirror.read(_named(slots, numbers, [], none)) is None
    _write(mirror, 7, [3], [13])
    assert mirror.read(_named([3], [11], [], none)) is None, "its slot has another frame now"


@pytest.mark.parametrize("place", MIRRORS)
def test_frames_in_slots_beyond_the_mirror_come_with_each_batch(place: str) -> None:
    mirror, mirrored = MIRRORS[place](PICTURES, 2), MirroredFrames()
    request = DrawRequest(1, 0, 0, 4, 0, None, mirror.number, mirror.slots)
    slots, numbers = np.array([0, 5, 1]), np.array([21, 22, 23])
    for sequence, expected in enumerate(([0, 1, 2], [1], [1])):
        carried = mirrored.missing(request, sequence, slots, numbers)
        assert carried.tolist() == expected
        frames = _pictures(*numbers[carried])
        mirror.write(7, slots[carried].astype(np.int32), numbers[carried], frames)
        read = mirror.read(_named(slots.tolist(), numbers.tolist(), carried.tolist(), frames))
        assert _shown(read) == _pictures(21, 22, 23).tolist()
    assert mirror.read(_named([5], [22], [], _pictures())) is None


def test_more_frames_than_one_write_takes_arrive_on_a_device() -> None:
    mirror, numbers = MIRRORS["device"](PICTURES, 200), list(range(1, 101))
    _write(mirror, 7, [2 * number for number in numbers[:99]] + [1], numbers)
    read = mirror.read(_named([2, 64, 198, 1], [1, 32, 99, 100], [], _pictures()))
    assert _shown(read) == _pictures(1, 32, 99, 100).tolist()


@pytest.mark.parametrize("place", MIRRORS)
def test_another_table_empties_the_mirror(place: str) -> None:
    mirror = MIRRORS[place](PICTURES, 100)
    _write(mirror, 7, [3], [11])
    assert mirror.number == 1
    _write(mirror, 8, [], [])
    _write(mirror, 7, [4], [12])
    assert mirror.number == 3
    assert mirror.read(_named([3], [11], [], _pictures())) is None


def test_a_mirror_that_cannot_grow_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    mirror, grow = FrameMirror(PICTURES, 10**9), GrowingRows.grow
    _write(mirror, 7, [3], [11])
    with pytest.raises(OSError):  # noqa: PT011 (the system's own words)
        mirror._rows.grow(1 << 60)
    monkeypatch.setattr(GrowingRows, "grow", lambda rows, _: grow(rows, 1 << 60))
    _write(mirror, 7, [2, 5 * FIRST_SLOTS], [12, 13])
    read = mirror.read(_named([3, 2], [11, 12], [], _pictures()))
    assert _shown(read) == _pictures(11, 12).tolist()
    assert mirror.read(_named([5 * FIRST_SLOTS], [13], [], _pictures())) is None
    assert mirror.slots == FIRST_SLOTS, "which it says with its next request"


# ----------------------------------------------------------------------------------------------------------------------
# Over Zenoh.


def _serve(node: Node, core: ReplayCore, folder: Path, asker: Node) -> None:
    ReplayService(node, core, ReplayCheckpoints(folder, 5)).start()
    await_service(asker, replay_key(asker, "snapshot"))


def test_batches_are_equal_while_the_table_grows_and_evicts(nodes: tuple[Node, Node], tmp_path: Path) -> None:
    """They are those of a twin that is not mirrored, and so is what a journal would have."""
    server, asker = nodes
    config = replace(CONFIG, replay=replace(CONFIG.replay, capacity=2000))
    core, twin = ReplayCore(config, NUMBERS), ReplayCore(config, NUMBERS)
    _serve(server, core, tmp_path, asker)
    client, inserted = _client(asker, 1, 0, 1, 10**6), 0
    for segments in (10, 400, 500, 1000):
        for sequence in range(inserted, segments):
            for each in (core, twin):
                _insert(each, sequence)
        inserted = segments
        for _ in range(20):
            batch, reply = _batch(client), twin.draw(DrawRequest(1, twin.drawn, twin.drawn, 4, 0))
            assert isinstance(reply, Reply)
            expected = reply.batch.read()
            for name, column in {**expected.columns(), "frames": expected.frames}.items():
                np.testing.assert_array_equal({**batch.columns(), "frames": batch.frames}[name], column)
    assert core.table.evicted > 0


def test_a_learner_that_takes_over_begins_with_an_empty_mirror(nodes: tuple[Node, Node], tmp_path: Path) -> None:
    server, asker = nodes
    core = ReplayCore(CONFIG, NUMBERS)
    for sequence in range(4):
        _insert(core, sequence)
    _serve(server, core, tmp_path, asker)
    first, second = _client(asker, 1, 0, 1, 1000), _client(asker, 2, 5, 3, 1000)
    for _ in range(10):
        _assert_right(_batch(first))
    for _ in range(10):
        _assert_right(_batch(second))
    with pytest.raises(Refused, match="another learner"):
        first.next()


def test_the_mirror_follows_the_next_service(nodes: tuple[Node, Node], endpoint: str, tmp_path: Path) -> None:
    """Each has the same transitions, in other slots; batches that were asked for ahead meet its end."""
    learner, _ = nodes
    core = ReplayCore(CONFIG, NUMBERS)
    for sequence in range(3):
        _insert(core, sequence)
    client = _client(learner, 1, 0, 4, 1000)
    for number in range(3):
        _insert(core, 3 + number)
        with Node(open_session((), (endpoint,)), "test", "replay", new_incarnation()) as node:
            _serve(node, core, tmp_path / str(number), learner)
            for _ in range(10):
                while (got := client.next()) is None:
                    pass
                _assert_right(got[0])
        core = _restored(core)


def _sent(port: int) -> int:
    """Bytes that this process has sent from a TCP port and that have been acknowledged, by the kernel's count."""
    total = 0
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if not str(entry.readlink()).startswith("socket:"):
                continue
        with suppress(OSError), socket.fromfd(int(entry.name), socket.AF_INET, socket.SOCK_STREAM) as opened:
            if opened.getsockname()[1] == port and opened.getpeername():
                info = opened.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
                total += struct.unpack_from("Q", info, 120)[0]  # tcpi_bytes_acked
    return total


def _atari_segments(spec: EnvSpec) -> Iterator[Segment]:
    """Segments of 16 steps of one stream, each frame different."""
    rng, sequence, steps = np.random.default_rng(0), 0, 16
    frames = rng.integers(0, 256, (spec.stack + steps, *spec.frame_shape)).astype(np.uint8)
    index = (np.arange(steps)[:, None] + np.arange(spec.stack)).astype(np.int32)
    while True:
        yield make_segment(
            spec, sequence, steps, frames=frames, obs_index=index, next_index=index + 1, carried=4 * (sequence > 0)
        )
        sequence += 1
        fresh = rng.integers(0, 256, (steps, *spec.frame_shape)).astype(np.uint8)
        frames = np.concatenate((frames[-spec.stack :], fresh))


def test_a_batch_of_atari_takes_60_kb_of_the_wire(tmp_path: Path) -> None:
    """At an update every four steps, counted by the kernel; without a mirror it takes 1.1 MB."""
    spec = EnvSpec("Atari", (84, 84), "uint8", 4, 4)
    config = replace(
        CONFIG,
        learner=LearnerSettings(batch_size=32),
        replay=ReplaySettings(capacity=1000, learning_starts=500, ratio=0.25, tolerance=1e6),
    )
    core, segments = ReplayCore(config, spec), _atari_segments(spec)
    with ExitStack() as stack:
        session = open_session(("tcp/127.0.0.1:0",))
        server = stack.enter_context(Node(session, "test", "replay", new_incarnation()))
        (endpoint,) = locators(session)
        asker = stack.enter_context(Node(open_session((), (endpoint,)), "test", "learner", new_incarnation()))
        _serve(server, core, tmp_path, asker)
        inserts, port = InsertClient(asker, Stop(), window=2), int(endpoint.rpartition(":")[2])

        def insert(count: int) -> None:
            for _ in range(count):
                assert inserts.submit(next(segments))
            assert inserts.drain()

        def per_batch(client: SampleClient, rounds: int) -> float:
            before = _sent(port)
            for _ in range(rounds):
                insert(1)
                for _ in range(4):
                    _batch(client)
            return (_sent(port) - before) / (4 * rounds)

        insert(40)
        mirror = FrameMirror(spec, 10_000)
        client = SampleClient(asker, _ended(), 1, spec, 32, 4, mirror=mirror)
        first = per_batch(client, 15)
        assert first * 60 < 7200 * (640 + 16 * 15) + 6000 * 64, "also at first no frame is sent twice"
        assert 7056 < per_batch(client, 40) < 60_000
        whole = SampleClient(asker, _ended(), 2, spec, 32, 4)
        assert per_batch(whole, 2) > 1_000_000


def test_priorities_arrive_with_requests_for_several_batches(nodes: tuple[Node, Node], tmp_path: Path) -> None:
    server, asker = nodes
    config = replace(CONFIG, replay=replace(CONFIG.replay, sampling="prioritized", priority_exponent=1.0))
    core = ReplayCore(config, NUMBERS)
    for sequence in range(3):
        _insert(core, sequence)
    _serve(server, core, tmp_path, asker)
    client = _client(asker, 1, 0, 4, 1000)
    chosen = int(_batch(client).ids[0])
    for number in range(20):
        batch = _batch(client)
        client.prioritise(batch.ids, np.where(batch.ids == chosen, 1e6, 1e-3).astype(np.float32))
        if number > 8:
            assert (batch.ids == chosen).all()


# ----------------------------------------------------------------------------------------------------------------------
# How much memory it may take, and its setting.


def test_the_mirror_takes_a_share_of_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coop.common.settings.capacity.memory_limit", lambda: MemoryLimit(2**30, "this test allows"))
    atari, each = EnvSpec("Atari", (84, 84), "uint8", 4, 4), 84 * 84 + 8

    def slots(capacity: int, eviction: str = "fifo") -> int:
        return mirror_slots(replace(CONFIG, replay=replace(CONFIG.replay, capacity=capacity, eviction=eviction)), atari)

    assert slots(1000) * each <= MIRROR_SHARE * 2**30 < (slots(1000) + 1) * each
    left = 2**30 - estimated_bytes(atari, 100_000)
    assert slots(100_000) * each <= left / 2 < (slots(100_000) + 1) * each, "the table may be on this machine"
    assert slots(100_000, "reservoir") == 0


@pytest.mark.parametrize(
    ("mirror", "numbers", "kept"),
    [("auto", 15, False), ("auto", 16, True), ("on", 1, True), ("on", 16, True), ("off", 16, False)],
)
def test_frames_hardly_larger_than_their_names_are_mirrored_if_asked(mirror: Any, numbers: int, kept: bool) -> None:
    config = replace(CONFIG, learner=replace(CONFIG.learner, mirror=mirror))
    assert mirrors(config, EnvSpec("floats", (numbers,), "float32", 1, 2)) == kept


def test_rows_that_grow_keep_what_they_held() -> None:
    rows = GrowingRows(3, 10)
    rows.view[:] = np.arange(30, dtype=np.uint8).view(rows.dtype)
    rows.grow(10**6)
    assert len(rows.view) == 10**6
    assert rows.view[:11].tobytes() == bytes([*range(30), 0, 0, 0])


def test_the_setting_may_change_when_a_run_goes_on_and_means_nothing_in_lockstep() -> None:
    off = replace(CONFIG, learner=replace(CONFIG.learner, mirror="off"))
    check_resumed(off, CONFIG, Path("runs/a/config.toml"))
    (line,) = without_effect(off, {"learner.mirror"}, lockstep=True)
    assert line.startswith("--learner.mirror has no effect")
    assert not list(without_effect(off, {"learner.mirror"}, lockstep=False))
