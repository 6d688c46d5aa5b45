"""The journal: what was acknowledged is there after a kill, torn ends are cut, a full disk loses nothing."""

import errno
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from samples import make_segment
from test_checkpoints import CONFIG, save

from coop.common.errors import RunError, UsageError
from coop.common.messaging.conversation import drive
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.answers import Retry
from coop.common.messaging.messages.insert import encode_segment
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.console import Console
from coop.common.process.lifecycle import Stop
from coop.common.transitions import NO_IDS, NO_PRIORITIES, DrawRequest
from coop.common.types import EnvSpec
from coop.replay.core import ReplayCore, RetryLater
from coop.replay.persistence import journal as journal_module
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.persistence.journal import Journal, journal_files
from coop.replay.persistence.recovery import recover
from coop.replay.service import ReplayService


def _insert(core: ReplayCore, spec: EnvSpec, sequence: int) -> int | RetryLater:
    segment = make_segment(spec, sequence, acked=4 * sequence)
    return core.insert(segment, bytes(encode_segment("test", segment)))


def _draw(core: ReplayCore) -> bool:
    return not isinstance(core.draw(DrawRequest(1, core.drawn, max(0, core.drawn - 2), 4, 0)), RetryLater)


def _use(core: ReplayCore, spec: EnvSpec, sequences: range) -> None:
    for sequence in sequences:
        assert not isinstance(_insert(core, spec, sequence), RetryLater)
        while _draw(core):
            pass


def _assert_alike(core: ReplayCore, twin: ReplayCore) -> None:
    first, second = core.snapshot(0), twin.snapshot(0)
    assert first.state == second.state
    assert first.episodes == second.episodes
    assert first.table.meta == second.table.meta
    for name, array in first.table.arrays.items():
        np.testing.assert_array_equal(array, second.table.arrays[name])
    assert {reply[1] for reply in first.replies} <= {reply[1] for reply in second.replies}


def test_a_kill_loses_nothing(spec: EnvSpec, tmp_path: Path) -> None:
    core = ReplayCore(CONFIG, spec, Journal(tmp_path, 5, 1, keep=False))
    _use(core, spec, range(5))
    core.limit(core.limiter.changed(core.table.inserted, core.drawn, ratio=0.5))
    _use(core, spec, range(5, 9))
    with (tmp_path / "00000001.log").open("ab") as file:
        file.write(b"half a record, longer than its header")
    twin = ReplayCore(CONFIG, spec)
    number, notices = recover(twin, tmp_path, 1, 5)
    taken = f"36 transitions and {core.drawn} batches from the journal, which ends as a kill leaves it"
    assert (number, notices) == (2, [taken])
    _assert_alike(core, twin)
    twin.recorder = Journal(tmp_path, 5, number, keep=False)
    _use(twin, spec, range(9, 12))
    third = ReplayCore(CONFIG, spec)
    assert recover(third, tmp_path, 1, 5)[0] == 3, "behind the torn end, what follows is found"
    _assert_alike(twin, third)
    with pytest.raises(RunError, match="belongs to another run than the learner's"):
        recover(ReplayCore(CONFIG, spec), tmp_path, 1, 6)


def test_a_journal_of_another_format_is_refused(spec: EnvSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as older:
        older.setattr(journal_module, "FORMAT", 2)
        Journal(tmp_path, 5, 1, keep=False).close()
    with pytest.raises(UsageError, match=r"00000001\.log: format 2 of the journal, this program reads 3$"):
        recover(ReplayCore(CONFIG, spec), tmp_path, 1, 5)


@pytest.mark.parametrize("sync", [False, True])
def test_a_new_file_is_on_the_disk_before_anything_in_it_is_acknowledged(
    sync: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    fsync = os.fsync

    def noted(descriptor: int) -> None:
        synced.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", noted)
    journal = Journal(tmp_path / "journal", 5, 1, keep=False, sync=sync)
    assert synced[-2:] == ["00000001.log", "journal"]
    synced.clear()
    journal.roll()
    assert synced == (["00000001.log", "00000002.log", "journal"] if sync else [])
    journal.close()


@pytest.mark.parametrize("keep", [False, True])
def test_files_that_checkpoints_cover(keep: bool, spec: EnvSpec, tmp_path: Path) -> None:
    folder = tmp_path / "journal"
    journal = Journal(folder, 5, 1, keep=keep)
    core, checkpoints = ReplayCore(CONFIG, spec, journal), ReplayCheckpoints(tmp_path, 5, journal)
    for turn in range(4):
        _use(core, spec, range(3 * turn, 3 * turn + 3))
        save(core, checkpoints, turn, turn - 1)
    _use(core, spec, range(12, 14))
    assert journal_files(folder) == ([1, 2, 3, 4, 5] if keep else [4, 5]), (
        "those since the older checkpoint that is kept"
    )
    (tmp_path / "checkpoints" / "3" / "replay" / "state.msgpack").write_bytes(b"torn")
    twin = ReplayCore(CONFIG, spec)
    first, _ = ReplayCheckpoints(tmp_path, 5).restore(twin, 3)
    assert first == 4
    assert recover(twin, folder, first, 5)[0] == 6
    _assert_alike(core, twin)


def test_a_full_disk(spec: EnvSpec, small_disk: Path) -> None:
    journal = Journal(small_disk / "journal", 5, 1, keep=True)
    core, checkpoints = ReplayCore(CONFIG, spec, journal), ReplayCheckpoints(small_disk, 5, journal)
    filler = small_disk / "filler"
    filler.write_bytes(bytes(220_000))
    sequence = 0
    while not isinstance(outcome := _insert(core, spec, sequence), RetryLater):
        sequence += 1
        while core.drawn < core.table.inserted - CONFIG.replay.learning_starts:
            assert _draw(core)
    assert outcome.reason == "the journal can't be written: No space left on device"
    assert core.inserts_wait_for == outcome.reason
    before = core.drawn
    while _draw(core):
        pass
    assert core.samples_wait_for.endswith("; the journal can't be written: No space left on device")
    assert core.drawn > before, "training goes on as far as the limiter lets it"
    with pytest.raises(RunError, match="No space left on device"):
        save(core, checkpoints, 1)
    assert isinstance(_insert(core, spec, sequence), RetryLater)
    filler.unlink()
    assert _insert(core, spec, sequence) == 4 * sequence + 4
    twin = ReplayCore(CONFIG, spec)
    recover(twin, small_disk / "journal", 1, 5)
    _assert_alike(core, twin)
    save(core, checkpoints, 2)


def test_priorities_are_carried_out_again(spec: EnvSpec, tmp_path: Path) -> None:
    replay = replace(CONFIG.replay, sampling="prioritized", eviction="prioritized")
    config = replace(CONFIG, replay=replay)
    core = ReplayCore(config, spec, Journal(tmp_path, 5, 1, keep=False))
    ids, priorities = NO_IDS, NO_PRIORITIES
    for sequence in range(20):
        assert not isinstance(_insert(core, spec, sequence), RetryLater)
        while True:
            request = DrawRequest(1, core.drawn, core.drawn, 4, 0, ids=ids, priorities=priorities)
            if isinstance(got := core.draw(request), RetryLater):
                break
            ids = got.batch.columns["ids"]
            priorities = (0.1 + ids % 7).astype(np.float32)
    assert len(set(core.table.snapshot().arrays["priorities"].tolist())) > 3
    twin = ReplayCore(config, spec)
    recover(twin, tmp_path, 1, 5)
    _assert_alike(core, twin)


def test_no_insert_is_acknowledged_before_it_is_flushed(
    spec: EnvSpec, tmp_path: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed, gate = [], threading.Event()
    real = os.fdatasync

    def slow(file: int) -> None:
        gate.wait(20)
        real(file)
        flushed.append(os.fstat(file).st_size)

    monkeypatch.setattr(os, "fdatasync", slow)
    with served(endpoint, spec, tmp_path) as (client, _):
        pending = [client.begin(replay_key(client, "insert"), segment_bytes(spec, number)) for number in range(5)]
        time.sleep(0.5)
        assert [each.ready() for each in pending] == [None] * 5
        gate.set()
        assert [each.wait().kind for each in pending] == ["ack"] * 5
    assert len(flushed) < 5  # one for all that wait
    twin = ReplayCore(CONFIG, spec)
    recover(twin, tmp_path / "journal", 1, 5)
    assert twin.table.inserted == 20


def test_a_disk_that_fails_once_ends_the_service_and_acknowledges_nothing(
    spec: EnvSpec, tmp_path: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(file: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with served(endpoint, spec, tmp_path) as (client, service):
        monkeypatch.setattr(os, "fdatasync", fail)
        assert client.ask(replay_key(client, "insert"), segment_bytes(spec, 0)).kind == "retry"
        monkeypatch.undo()
        again = client.ask(replay_key(client, "insert"), segment_bytes(spec, 0))
        assert Retry.decode(again).reason.startswith("the journal can't be flushed"), "it is not trusted again"
        stop = Stop()
        drive(service.serving(stop, Console()), stop)
        assert stop.failed
        assert stop.reason == "the journal can't be flushed to the disk: Input/output error"


@pytest.mark.parametrize("call", ["fdatasync", "fsync"])
def test_what_a_flush_has_failed_to_write_is_gone_from_the_journal(
    spec: EnvSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    def fail(file: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    lock = threading.Condition()
    journal = Journal(tmp_path, 5, 1, keep=False, sync=True)
    core = ReplayCore(CONFIG, spec, journal)
    _use(core, spec, range(2))
    journal.flush(lock)
    _use(core, spec, range(2, 4))
    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OSError, match="Input/output error"):
        journal.flush(lock) if call == "fdatasync" else journal.roll()
    monkeypatch.undo()
    with pytest.raises(OSError, match="Input/output error"):
        journal.flush(lock)
    assert isinstance(_insert(core, spec, 4), RetryLater)
    with pytest.raises(OSError, match="Input/output error"):
        journal.close()
    twin = ReplayCore(CONFIG, spec)
    _, notices = recover(twin, tmp_path, 1, 5, sync=True)
    assert twin.table.inserted == 8, "what was flushed, and may have been acknowledged"
    assert len(notices) == 1, "and nothing is said to be lost"


@pytest.mark.parametrize("sync", [False, True])
def test_a_file_that_a_dead_machine_has_shortened_is_said_by_the_next_one(
    spec: EnvSpec, tmp_path: Path, sync: bool
) -> None:
    """Its end looks as a kill leaves it, and so the draws of the next file were taken for deviations."""
    journal = Journal(tmp_path, 5, 1, keep=False)
    core = ReplayCore(CONFIG, spec, journal)
    _use(core, spec, range(2))
    whole = journal._end
    _use(core, spec, range(2, 4))
    journal.roll()
    _use(core, spec, range(4, 6))
    journal.close()
    os.truncate(tmp_path / "00000001.log", whole)
    twin = ReplayCore(CONFIG, spec)
    _, notices = recover(twin, tmp_path, 1, 5, sync=sync)
    assert twin.table.inserted == 16
    assert twin.damaged == (0 if sync else 8), "what was not flushed was not acknowledged"
    assert notices[1].startswith(f"{tmp_path}: 8 transitions before file 2 are missing")
    assert len(notices) == (2 if sync else 3)


@contextmanager
def served(endpoint: str, spec: EnvSpec, folder: Path) -> Iterator[tuple[Node, ReplayService]]:
    """A service with a journal that is flushed, and a client of it."""
    journal = Journal(folder / "journal", 5, 1, keep=False, sync=True)
    core = ReplayCore(CONFIG, spec, journal)
    with (
        Node(open_session((endpoint,)), "test", "replay", new_incarnation()) as node,
        Node(open_session((), (endpoint,)), "test", "actor", new_incarnation()) as client,
    ):
        service = ReplayService(node, core, ReplayCheckpoints(folder, 5, journal), synced=journal)
        service.start()
        yield client, service


def segment_bytes(spec: EnvSpec, sequence: int) -> bytearray:
    return encode_segment("test", make_segment(spec, sequence, acked=0))
