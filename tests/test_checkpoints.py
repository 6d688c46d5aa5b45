"""Checkpoints on disk: what is restored goes on alike, torn ones are passed over, old ones go."""

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forked import forked_process
from samples import make_segment, until
from table_reference import check_references

from coop.common.errors import RunError
from coop.common.process.memory import keep_freed_memory
from coop.common.settings.config import LearnerSettings, ReplaySettings, RunConfig
from coop.common.transitions import DrawRequest
from coop.common.types import EnvSpec, EpisodeRecord
from coop.records.checkpoints import DONE, RECORDS, check_part, checkpoint_numbers
from coop.records.learner_checkpoints import load_learner, newest_checkpoint, saving_checkpoint
from coop.records.resumption import Start, go_back, survey
from coop.replay.core import ReplayCore, RetryLater
from coop.replay.episodes import MOST, EpisodeLog
from coop.replay.persistence.checkpoints import ReplayCheckpoints, part_path, settle_parts
from coop.replay.persistence.storage import Mark, save_snapshot

CONFIG = RunConfig(
    run="test",
    total_steps=1000,
    learner=LearnerSettings(batch_size=4),
    replay=ReplaySettings(capacity=40, learning_starts=8, tolerance=8.0),
)


def _used_core(spec: EnvSpec) -> ReplayCore:
    core = ReplayCore(CONFIG, spec)
    drawn = 0
    for sequence in range(15):
        assert not isinstance(core.insert(make_segment(spec, sequence, acked=4 * sequence)), RetryLater)
        while not isinstance(core.draw(DrawRequest(1, drawn, max(0, drawn - 2), 4, 0)), RetryLater):
            drawn += 1
    core.insert(make_segment(spec, 3))
    return core


_asked = count()


def save(core: ReplayCore, checkpoints: ReplayCheckpoints, number: int, *keep: int) -> None:
    checkpoints.begin(core, threading.Condition(), number, list(keep), (1, next(_asked)))
    until(lambda: checkpoints.written(number))


def test_a_restored_core_goes_on_alike(spec: EnvSpec, tmp_path: Path) -> None:
    core, twin = _used_core(spec), ReplayCore(CONFIG, spec)
    base = core.drawn - 2
    save(core, ReplayCheckpoints(tmp_path, 5), base)
    assert "restored checkpoint" in ReplayCheckpoints(tmp_path, 5).restore(twin, base)[1]
    for one in (core, twin):
        assert one.insert(make_segment(spec, 14)) == 60, "a repeated delivery is still known"
        assert one.insert(make_segment(spec, 15)) == 64
    assert (twin.duplicates, twin.lost, twin.episodes_total) == (2, 0, 16)
    for sequence in (base, base + 1, core.drawn, core.drawn + 1):
        request = DrawRequest(1, sequence, base, 4, 0)
        first, second = core.draw(request), twin.draw(request)
        assert not isinstance(first, RetryLater)
        assert not isinstance(second, RetryLater)
        for name in ("ids", "frames", "obs_index"):
            np.testing.assert_array_equal(getattr(first.batch.read(), name), getattr(second.batch.read(), name))
        assert first.drawn == second.drawn
    assert twin.snapshot(base).state == core.snapshot(base).state


def test_a_run_that_was_complete_may_go_on_for_longer(spec: EnvSpec, tmp_path: Path) -> None:
    core, checkpoints = _used_core(spec), ReplayCheckpoints(tmp_path, 5)
    core.limit(core.limiter.changed(core.table.inserted, core.drawn, ratio=0.5))
    save(core, checkpoints, 10)
    longer = replace(CONFIG, total_steps=2 * CONFIG.total_steps)
    checkpoints.restore(twin := ReplayCore(longer, spec), 10)
    assert (twin.limiter.total, twin.limiter.ratio) == (longer.total_steps, 0.5)
    assert twin.limiter.why_not_insert(CONFIG.total_steps, core.limiter.draws_total or 0) is None


def test_the_frames_of_old_answers_are_given_back(spec: EnvSpec, tmp_path: Path) -> None:
    core, twin = _used_core(spec), ReplayCore(CONFIG, spec)
    save(core, ReplayCheckpoints(tmp_path, 5), core.drawn - 2)
    ReplayCheckpoints(tmp_path, 5).restore(twin, core.drawn - 2)
    for one in (core, twin):
        assert len(one.repeatable()) == 2
        assert isinstance(one.draw(DrawRequest(1, one.drawn, one.drawn, 4, 0)), RetryLater)
        assert not one.repeatable()
        check_references(one.table)


def test_torn_parts_are_passed_over_and_old_ones_go(spec: EnvSpec, tmp_path: Path) -> None:
    core, checkpoints = _used_core(spec), ReplayCheckpoints(tmp_path, 5)
    for number in (10, 20, 30):
        save(core, checkpoints, number, number - 10)
        core.insert(make_segment(spec, number))
    parts = {number: tmp_path / "checkpoints" / str(number) / "replay" for number in (10, 20, 30)}
    assert [parts[number].exists() for number in (10, 20, 30)] == [False, True, True]
    with (parts[30] / "rewards.npy").open("r+b") as file:
        file.seek(-1, 2)
        file.write(b"\7")
    found = checkpoints.restore(twin := ReplayCore(CONFIG, spec), 30)[1]
    assert f"passed over {parts[30]}, rewards.npy: wrong checksum; " in found
    assert "restored checkpoint 20" in found
    assert twin.table.inserted == 60
    assert checkpoints.restore(ReplayCore(CONFIG, spec), 19) == (1, "no checkpoint to restore"), (
        "the learner is back before it"
    )
    (parts[20] / "state.msgpack").write_bytes(b"")
    assert "no checkpoint to restore" in checkpoints.restore(ReplayCore(CONFIG, spec), 20)[1]
    (parts[30] / "rewards.npy").unlink()
    with pytest.raises(RunError, match="belongs to another run than the learner's"):
        ReplayCheckpoints(tmp_path, 6).restore(ReplayCore(CONFIG, spec), 30)


class Killed(BaseException):
    """In place of a kill."""


def _killed_after(calls: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the process die at the next call for a file, of those that move or remove one, after so many."""
    left = count(calls, -1)

    def call(real: Callable[..., None], *args: object) -> None:
        if next(left) <= 0:
            raise Killed
        real(*args)

    for name in ("rename", "replace", "unlink", "rmdir"):
        monkeypatch.setattr(os, name, partial(call, getattr(os, name)))


def test_a_part_that_is_written_anew_is_whole_whenever_a_kill_comes(
    spec: EnvSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    core = _used_core(spec)
    save(core, ReplayCheckpoints(tmp_path, 5), 10)
    inserted, kills = core.table.inserted, 0
    while True:
        core.insert(make_segment(spec, 100 + kills))
        with monkeypatch.context() as patches:
            _killed_after(kills, patches)
            try:
                save_snapshot(core.snapshot(10, [10]), threading.Condition(), part_path(tmp_path, 10), Mark(5, 10, 0))
            except Killed:
                kills += 1
            else:
                break
        settle_parts(tmp_path)
        found = ReplayCheckpoints(tmp_path, 5)
        assert found.intact() == [10], f"after {kills - 1} calls"
        twin = ReplayCore(CONFIG, spec)
        found.restore(twin, 10)
        assert inserted <= twin.table.inserted <= core.table.inserted
    assert kills > 8
    assert [path.name for path in part_path(tmp_path, 10).parent.iterdir()] == ["replay"]


def test_a_late_copy_of_a_request_begins_no_checkpoint(spec: EnvSpec, tmp_path: Path) -> None:
    core, checkpoints, lock = _used_core(spec), ReplayCheckpoints(tmp_path, 5), threading.Condition()
    for number, keep in ((10, []), (20, [10])):
        checkpoints.begin(core, lock, number, keep, (1, number))
        until(partial(checkpoints.written, number))
    there = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    core.insert(make_segment(spec, 20))
    checkpoints.begin(core, lock, 20, [10], (1, 20))
    assert checkpoints.written(20)
    with pytest.raises(RunError, match="checkpoint 10 was asked for before checkpoint 20"):
        checkpoints.begin(core, lock, 10, [], (1, 10))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == there
    checkpoints.begin(core, lock, 10, [], (2, 0))
    until(partial(checkpoints.written, 10))
    assert checkpoints.intact() == [10], "another learner is back before it"


def test_a_writer_that_dies_of_anything_has_written_nothing(
    spec: EnvSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise OverflowError

    checkpoints = ReplayCheckpoints(tmp_path, 5)
    monkeypatch.setattr("coop.replay.persistence.storage.write_manifest", fails)
    monkeypatch.setattr(threading, "excepthook", lambda args: None)
    checkpoints.begin(_used_core(spec), threading.Condition(), 10, [], (1, 0))
    with pytest.raises(RunError, match="10/replay: OverflowError"):
        until(lambda: checkpoints.written(10))


def test_old_folders_go_where_nothing_else_is_in_them(spec: EnvSpec, tmp_path: Path) -> None:
    core, checkpoints = _used_core(spec), ReplayCheckpoints(tmp_path, 5)
    (tmp_path / "checkpoints" / "20").mkdir(parents=True)
    (tmp_path / "checkpoints" / "20" / "learner.pt").write_bytes(b"the learner's")
    for number in (10, 20, 30):
        save(core, checkpoints, number)
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["20", "30"]


def test_episodes_are_kept_as_long_as_they_may_be_asked_for(spec: EnvSpec, tmp_path: Path) -> None:
    core, checkpoints, sequence = ReplayCore(CONFIG, spec), ReplayCheckpoints(tmp_path, 5), 0
    first_episodes: dict[int, int] = {}
    for turn in range(1, 6):
        for _ in range(10):
            core.insert(make_segment(spec, sequence))  # an episode each
            sequence += 1
            while not isinstance(
                reply := core.draw(DrawRequest(1, core.drawn, core.drawn, 4, sequence - 1)), RetryLater
            ):
                last = reply
        first_episodes[core.drawn] = last.drawn.first_episode
        save(core, checkpoints, core.drawn, *list(first_episodes)[-3:-1])
        kept = core.snapshot(core.drawn, list(first_episodes)[-3:-1])
        assert kept.state["first_episode"] <= first_episodes[list(first_episodes)[max(0, turn - 3)]]
        assert len(kept.episodes) <= 31
        kept.table.frames.release()
    twin = ReplayCore(CONFIG, spec)
    back = list(first_episodes)[-2]
    ReplayCheckpoints(tmp_path, 5).restore(twin, back)
    for number in range(twin.table.inserted // 4, twin.table.inserted // 4 + 2):
        assert not isinstance(twin.insert(make_segment(spec, number)), RetryLater)
    for one in (core, twin):
        reply = one.draw(DrawRequest(2, back, back, 4, first_episodes[back]))
        assert not isinstance(reply, RetryLater)
        assert reply.drawn.first_episode == first_episodes[back]
        steps = [record.env_step for record in reply.drawn.episodes]
        assert steps == [4 * (number + 1) for number in range(first_episodes[back], one.table.inserted // 4)]
    kept = twin.snapshot(twin.drawn, [back])
    assert kept.state["first_episode"] == first_episodes[back], (
        "the restored one knows which episodes a checkpoint needs"
    )
    kept.table.frames.release()


def test_a_draw_that_may_be_repeated_keeps_its_episodes(spec: EnvSpec) -> None:
    core = ReplayCore(CONFIG, spec)
    for number in range(3):
        core.insert(make_segment(spec, number))
    for sequence, episodes_from in ((0, 0), (1, 2)):
        assert not isinstance(core.draw(DrawRequest(1, sequence, 0, 4, episodes_from)), RetryLater)
    for base, first in ((0, 0), (1, 2)):
        kept = core.snapshot(base, [base])
        assert kept.state["first_episode"] == first
        kept.table.frames.release()


def test_a_run_without_checkpoints_keeps_a_bounded_number_of_episodes(spec: EnvSpec) -> None:
    log = EpisodeLog()
    (end,) = make_segment(spec).episodes
    for number in range(3):
        log.add([EpisodeRecord(number, 1, 0, end)] * MOST)
    assert (log.total, log.first) == (3 * MOST, 2 * MOST)
    assert log.since(0, 2)[0] == 2 * MOST


def test_the_learner_s_count_is_the_count_of_draws(spec: EnvSpec) -> None:
    core = _used_core(spec)
    drawn = core.drawn
    assert isinstance(core.draw(DrawRequest(1, drawn, drawn - 1, 4, 0)), RetryLater)
    assert not isinstance(core.draw(DrawRequest(2, 5, 5, 4, 3)), RetryLater), "another learner, back at update 5"
    assert core.drawn == 6
    assert [drawn.sequence for _, drawn in core.repeatable()] == [5], "the other one's are forgotten"
    with pytest.raises(RunError, match="another learner has taken over"):
        core.draw(DrawRequest(1, drawn, drawn, 4, 0))
    core.draw(DrawRequest(2, 20, 20, 4, 0))
    assert core.drawn == 21, "updates that this table was not asked for"
    older = ReplayCore(CONFIG, spec)
    older.insert(make_segment(spec))
    assert isinstance(older.draw(DrawRequest(2, 20, 20, 4, 9)), RetryLater)
    assert (older.drawn, older.episodes_total) == (20, 9), "episodes that the learner knows keep their numbers"
    assert isinstance(older.draw(DrawRequest(2, 30, 30, 4, 11)), RetryLater)
    assert (older.drawn, older.episodes_total) == (30, 11), "also of a learner that it knows"


def save_learner(run_dir: Path, number: int, state: dict[str, Any]) -> None:
    """A checkpoint of a learner whose records are empty."""
    with saving_checkpoint(run_dir, 5, number, state, records={}):
        pass


def finished(run_dir: Path) -> list[int]:
    return checkpoint_numbers(run_dir, DONE)


def test_learner_checkpoints(tmp_path: Path) -> None:
    for number in (100, 200, 300):
        save_learner(tmp_path, number, {"flat": torch.full((3,), float(number))})
    assert finished(tmp_path) == [200, 300]
    torn = tmp_path / "checkpoints" / "400"
    torn.mkdir()
    (torn / "learner.pt").write_bytes(b"half")
    assert finished(tmp_path) == [200, 300]
    newest = tmp_path / "checkpoints" / "300"
    (newest / "learner.pt").write_bytes((newest / "learner.pt").read_bytes()[:-9])
    found = survey(tmp_path, load=load_learner)
    assert found.newest is not None
    assert found.newest.state["flat"].tolist() == [200.0] * 3
    assert set(found.problems) == {300, 400}
    moved = go_back(found, found.newest.number)
    assert finished(tmp_path) == [200], "the torn ones count not among the two to keep"
    (aside,) = (tmp_path / "aside").iterdir()
    assert moved == f"what is younger is in {aside}"
    assert (aside / "checkpoints" / "400" / "learner.pt").read_bytes() == b"half", "and nothing is deleted"

    with pytest.raises(RunError), saving_checkpoint(tmp_path, 5, 500, {}, records={}) as folder:
        raise RunError(f"no room for {folder}")
    assert finished(tmp_path) == [200]
    assert not (tmp_path / "checkpoints" / "500").exists()
    assert newest_checkpoint(tmp_path) is not None


def resident() -> int:
    """Bytes of memory that this process takes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def _saves_one(folder: Path) -> None:
    for name in RECORDS:
        (folder / name).touch()
    keep_freed_memory()
    pieces = [bytes(4000) for _ in range(20_000)]
    kept = pieces[::1000]
    del pieces
    before = resident()
    save_learner(folder, 100, {"flat": torch.zeros(3)})
    (folder / "freed").write_text(f"{before - resident()} {len(kept)}")


def test_after_a_checkpoint_a_process_returns_what_it_has_freed(tmp_path: Path) -> None:
    forked_process(_saves_one, tmp_path).join()
    freed, kept = map(int, (tmp_path / "freed").read_text().split())
    assert kept == 20
    assert freed > 60e6, "of 80 MB"


def test_a_checkpoint_that_is_saved_again_is_whole_meanwhile(tmp_path: Path) -> None:
    save_learner(tmp_path, 100, {"flat": torch.zeros(3)})
    path, fallbacks = tmp_path / "checkpoints" / "100", ["checkpoint 110: DONE is missing"]
    saving = saving_checkpoint(tmp_path, 5, 100, {}, records={}, fallbacks=fallbacks, keep=True)
    with pytest.raises(RunError, match="no room"), saving:
        raise RunError(f"no room beside {check_part(path, 100, 5).number}")
    assert check_part(path, 100, 5).fallbacks == []
    with saving_checkpoint(tmp_path, 5, 100, {}, records={}, fallbacks=fallbacks, keep=True):
        (path / "replay").mkdir()
    assert check_part(path, 100, 5).fallbacks == fallbacks
    assert (path / "replay").exists(), "where the replay service has written its part meanwhile"
    (path / "learner.pt").write_bytes(b"half")
    with saving_checkpoint(tmp_path, 5, 100, {"flat": torch.ones(3)}, records={}, keep=True):
        pass
    assert load_learner(path)["flat"].tolist() == [1.0] * 3, "what is damaged is written"


def test_a_checkpoint_that_is_replaced_is_whole_whenever_a_kill_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in RECORDS:
        (tmp_path / name).touch()
    save_learner(tmp_path, 100, {"kills": -1})
    kills = 0
    while True:
        with monkeypatch.context() as patches:
            _killed_after(kills, patches)
            try:
                save_learner(tmp_path, 100, {"kills": kills})
            except Killed:
                kills += 1
            else:
                break
        found, _ = Start(resume=True).prepare(tmp_path, replay=False, load=load_learner)
        assert found.newest is not None
        assert found.newest.state["kills"] in range(-1, kills)
    assert kills > 4
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["100"]
