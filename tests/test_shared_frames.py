"""Frames that the learner reads in the replay service's own memory: the same batches, and no frame on a link."""

import fcntl
import gc
import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from samples import await_service, make_segment

from coop.common.errors import BadMessage
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.insert import encode_segment
from coop.common.messaging.messages.sample import BatchReader, Memory, NamedBatchReader, encode_request
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.session import open_session
from coop.common.messaging.shared_frames import SharedFrames
from coop.common.messaging.transport import Node, Refused, new_incarnation
from coop.common.messaging.wire import Message
from coop.common.process.lifecycle import Stop
from coop.common.process.shared_memory import SharedMemory, SharedMemoryReader
from coop.common.settings.config import LearnerSettings, ReplaySettings, RunConfig
from coop.common.transitions import Batch, DrawRequest
from coop.common.types import EnvSpec
from coop.replay.core import ReplayCore, Reply
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.persistence.journal import Journal
from coop.replay.persistence.recovery import recover
from coop.replay.service import ReplayService
from coop.replay.table.frames import FIRST_SLOTS

SPEC = EnvSpec("pictures", (12, 12), "uint8", 1, 2)
CONFIG = RunConfig(
    run="test",
    total_steps=100_000,
    learner=LearnerSettings(batch_size=4),
    replay=ReplaySettings(capacity=100, learning_starts=8, tolerance=1e9),
)
NOWHERE = f"{os.getppid()}/0/coop-{'0' * 32}"  # there is such a process, but its descriptor is something else


def _insert(core: ReplayCore, *sequences: int) -> None:
    for sequence in sequences:
        frames = np.random.default_rng(sequence).integers(0, 256, (5, *SPEC.frame_shape), np.uint8)
        segment = make_segment(SPEC, sequence, frames=frames)
        assert core.insert(segment, bytes(encode_segment("test", segment))) == 4 * sequence + 4


def _serve(node: Node, core: ReplayCore, folder: Path, asker: Node) -> None:
    ReplayService(node, core, ReplayCheckpoints(folder, 5)).start()
    await_service(asker, replay_key(asker, "snapshot"))


def _sampler(node: Node, prefetch: int = 1) -> SampleClient:
    """With a prefetch of one it draws one batch after another, and so does a twin of a table that changes meanwhile."""
    return SampleClient(node, Stop(), 1, SPEC, 4, prefetch, shared_memory=True)


def _next(sampler: SampleClient) -> Batch:
    while (got := sampler.next()) is None:
        pass
    return got[0]


def _draw(asker: Node, sequence: int, memory: str | None, base: int = 0) -> Message:
    request = DrawRequest(1, sequence, base, 4, 0, memory)
    return asker.ask(replay_key(asker, "sample"), encode_request("test", request))


def _draw_here(core: ReplayCore) -> Batch:
    reply = core.draw(DrawRequest(1, core.drawn, core.drawn, 4, 0))
    assert isinstance(reply, Reply)
    return reply.batch.read()


def _assert_equal(one: Batch, other: Batch) -> None:
    columns = other.columns() | {"frames": other.frames}
    for name, array in (one.columns() | {"frames": one.frames}).items():
        assert array.dtype == columns[name].dtype
        np.testing.assert_array_equal(array, columns[name])


def test_batches_are_equal_while_the_table_grows_and_evicts(
    nodes: tuple[Node, Node], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, asker = nodes
    monkeypatch.setattr("coop.replay.service.encode_batch", None)  # no frame travels
    config = replace(CONFIG, replay=replace(CONFIG.replay, capacity=3 * FIRST_SLOTS))
    core, twin = ReplayCore(config, SPEC, shared_memory=True), ReplayCore(config, SPEC)
    _serve(server, core, tmp_path, asker)
    sampler, inserted = _sampler(asker), 0
    for segments in (10, FIRST_SLOTS // 4 + 10, 2 * FIRST_SLOTS // 4, 5 * FIRST_SLOTS // 4):
        for each in (core, twin):
            _insert(each, *range(inserted, segments))
        inserted = segments
        for _ in range(5):
            _assert_equal(_next(sampler), _draw_here(twin))
    assert core.table.evicted > 0


def test_a_message_carries_frames_or_slots_or_the_memory(nodes: tuple[Node, Node], tmp_path: Path) -> None:
    server, asker = nodes
    core = ReplayCore(CONFIG, SPEC, shared_memory=True)
    _insert(core, *range(20))
    _serve(server, core, tmp_path, asker)
    address = Memory.decode(_draw(asker, 0, "")).address
    assert Memory.decode(_draw(asker, 0, NOWHERE)).address == address == core.table.shared_memory
    assert core.drawn == 0, "the learner asks again"
    by_link, by_slot = _draw(asker, 0, None), _draw(asker, 0, address)
    assert "slots" not in by_link.arrays
    assert not len(by_slot.arrays["frames"])
    draws, (named,) = NamedBatchReader(SPEC)(by_slot)
    assert draws.memory == address
    batch = Batch(frames=SharedFrames(address, SPEC).read(named.slots), **named.columns)
    _assert_equal(batch, BatchReader(SPEC)(by_link)[0])
    with pytest.raises(BadMessage, match="kind"):
        BatchReader(SPEC)(by_slot)
    with pytest.raises(Refused, match="memory"):
        _draw(asker, 1, f"{address}/..")


def test_a_service_with_private_memory_sends_frames(nodes: tuple[Node, Node], tmp_path: Path) -> None:
    server, asker = nodes
    core = ReplayCore(CONFIG, SPEC)
    _insert(core, *range(20))
    _serve(server, core, tmp_path, asker)
    for sequence, memory in enumerate((None, "", NOWHERE)):
        assert "frames" in _draw(asker, sequence, memory).arrays


def test_a_system_without_such_memory_sends_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "memfd_create")
    core, twin = ReplayCore(CONFIG, SPEC, shared_memory=True), ReplayCore(CONFIG, SPEC)
    assert core.table.shared_memory == ""
    for each in (core, twin):
        _insert(each, *range(20))
    _assert_equal(_draw_here(core), _draw_here(twin))


def test_a_drawn_batch_stays_until_the_learner_has_it(nodes: tuple[Node, Node], tmp_path: Path) -> None:
    server, asker = nodes
    core = ReplayCore(CONFIG, SPEC, shared_memory=True)
    address = core.table.shared_memory
    _insert(core, *range(20))
    _serve(server, core, tmp_path, asker)
    shared, read = SharedFrames(address, SPEC), BatchReader(SPEC)
    slots = _draw(asker, 0, address).arrays["slots"]
    before = shared.read(slots)
    _insert(core, *range(20, 200))
    _draw(asker, 1, address)
    np.testing.assert_array_equal(shared.read(slots), before)
    np.testing.assert_array_equal(read(_draw(asker, 0, None))[0].frames, before)
    _draw(asker, 2, address, base=1)
    _insert(core, *range(200, 400))
    assert not (shared.read(slots) == before).any(axis=(1, 2)).all(), "its slots are used again"


def test_a_learner_that_does_not_reach_the_memory_gets_frames(
    nodes: tuple[Node, Node], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, asker = nodes
    core, twin = ReplayCore(CONFIG, SPEC, shared_memory=True), ReplayCore(CONFIG, SPEC)
    monkeypatch.setattr(core.table._frames, "shared_memory", NOWHERE)  # as it looks from another machine
    for each in (core, twin):
        _insert(each, *range(20))
    _serve(server, core, tmp_path, asker)
    sampler = _sampler(asker)
    for _ in range(3):
        _assert_equal(_next(sampler), _draw_here(twin))


def test_a_learner_follows_the_next_service(nodes: tuple[Node, Node], endpoint: str, tmp_path: Path) -> None:
    learner, _ = nodes
    twin = ReplayCore(CONFIG, SPEC)
    _insert(twin, *range(20))
    sampler, addresses = _sampler(learner), set()
    for number in range(3):
        core = ReplayCore(CONFIG, SPEC, shared_memory=True)
        _insert(core, *range(20))
        for _ in range(number):
            _draw_here(core)
        with Node(open_session((), (endpoint,)), "test", "replay", new_incarnation()) as node:
            _serve(node, core, tmp_path / str(number), learner)
            _assert_equal(_next(sampler), _draw_here(twin))
            assert core.drawn == number + 1
        addresses.add(core.table.shared_memory)
    assert len(addresses) == 3


def test_batches_that_are_asked_for_ahead_are_drawn_in_their_order(nodes: tuple[Node, Node], tmp_path: Path) -> None:
    server, asker = nodes
    core, twin = ReplayCore(CONFIG, SPEC, shared_memory=True), ReplayCore(CONFIG, SPEC)
    for each in (core, twin):
        _insert(each, *range(20))
    _serve(server, core, tmp_path, asker)
    sampler = _sampler(asker, prefetch=4)
    for _ in range(12):
        _assert_equal(_next(sampler), _draw_here(twin))


def test_slots_that_do_not_exist_are_refused() -> None:
    memory = SharedMemory(10 * 144)
    memory.mapped[:] = np.arange(10, dtype=np.uint8).repeat(144).tobytes()
    shared = SharedFrames(memory.address, SPEC)
    assert shared.read(np.array([9, 2]))[:, 3, 3].tolist() == [9, 2]
    assert shared.read(np.array([], np.int64)).shape == (0, 12, 12)
    for slots in ([0, 10], [-1, 3]):
        with pytest.raises(BadMessage, match=r"arrays\.slots: .* there are 10 slots"):
            shared.read(np.array(slots))


def test_the_journal_does_not_know_the_memory(tmp_path: Path) -> None:
    core = ReplayCore(CONFIG, SPEC, Journal(tmp_path, 5, 1, keep=False), shared_memory=True)
    address = core.table.shared_memory
    _insert(core, *range(20))
    for sequence in range(3):
        assert isinstance(core.draw(DrawRequest(1, sequence, 0, 4, 0, address)), Reply)
    assert not any(address.encode() in path.read_bytes() for path in tmp_path.iterdir())
    twin = ReplayCore(CONFIG, SPEC)
    recover(twin, tmp_path, 1, 5)
    _assert_equal(_draw_here(twin), _draw_here(core))


WRITER = """
import sys
from coop.common.process.shared_memory import SharedMemory
memory = SharedMemory(4096)
memory.mapped[:5] = b"first"
print(memory.address, flush=True)
sys.stdin.readline()
memory.mapped.resize(8192)
memory.mapped[8187:] = b"later"
print("resized", flush=True)
sys.stdin.readline()
"""


def test_another_process_is_read_also_when_it_has_ended() -> None:
    with subprocess.Popen([sys.executable, "-c", WRITER], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as writer:
        assert writer.stdin is not None
        assert writer.stdout is not None
        address = writer.stdout.readline().decode().strip()
        reader = SharedMemoryReader(address)
        assert reader.map()[:5] == b"first"
        writer.stdin.write(b"\n")
        writer.stdin.flush()
        writer.stdout.readline()
        assert reader.map()[8187:] == b"later"
        writer.kill()
    assert reader.map()[8187:] == b"later"
    with pytest.raises(OSError, match=str(writer.pid)):
        SharedMemoryReader(address)


def test_only_the_memory_of_that_name_is_read(tmp_path: Path) -> None:
    memory = SharedMemory(4096)
    with pytest.raises(TypeError, match="readonly"):
        SharedMemoryReader(memory.address).map()[0] = 1
    process, number, name = memory.address.split("/")
    with pytest.raises(FileNotFoundError, match="that of another file"):
        SharedMemoryReader(f"{process}/{number}/coop-{'0' * 32}")
    with (tmp_path / "file").open("wb") as file, pytest.raises(FileNotFoundError):
        SharedMemoryReader(f"{process}/{file.fileno()}/{name}")
    with pytest.raises(FileNotFoundError):
        SharedMemoryReader(f"{2**22 + 1}/{number}/{name}")


def test_memory_cannot_become_smaller_under_its_readers() -> None:
    memory = SharedMemory(8192)
    with pytest.raises(PermissionError):
        memory.mapped.resize(4096)
    name = f"coop-{'1' * 32}"
    file = os.memfd_create(name, os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(file, 4096)
        with pytest.raises(PermissionError, match="smaller"):
            SharedMemoryReader(f"{os.getpid()}/{file}/{name}")
        fcntl.fcntl(file, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        assert len(SharedMemoryReader(f"{os.getpid()}/{file}/{name}").map()) == 4096
    finally:
        os.close(file)


def _open_memories() -> int:
    found = 0
    for entry in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            found += str(entry.readlink()).startswith("/memfd:coop-")
    return found


def test_a_table_and_its_reader_leave_nothing_open() -> None:
    gc.collect()
    before = _open_memories()
    core = ReplayCore(CONFIG, SPEC, shared_memory=True)
    shared = SharedFrames(core.table.shared_memory, SPEC)
    assert _open_memories() == before + 3, "of the owner, of its mapping, of the reader"
    del core, shared
    assert _open_memories() == before
