"""The buffer of a saved run as data: the transitions that its table would draw, after a checkpoint."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import Command, lines, wait_for

import coop
from coop.common.errors import RunError, UsageError
from coop.common.settings.tables import resolve
from coop.evaluation import export_cli
from coop.evaluation.dataset import export_dataset
from coop.lockstep.lockstep import Lockstep
from coop.records.run_directory import RunDirectory

EXAMPLES = Path(__file__).parents[1] / "examples" / "methods"
SMALL = {"capacity": 40, "learning_starts": 20}


def saved(path: Path, **tables: Any) -> Lockstep:
    """Save a short run, with a table that has evicted some transitions."""
    run = Lockstep(resolve({"method": "coop", "network": {"kind": "mlp", "hidden": [8]}, **tables}))
    with RunDirectory(path, run.config) as directory:
        for _ in range(70):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
        run.save(directory)
    run.env.close()
    return run


@pytest.mark.parametrize(
    ("env", "replay"),
    [
        ({"stack": 3}, {"eviction": "fifo"}),
        ({}, {"eviction": "reservoir", "sampling": "prioritized", "n_step": 2}),
        ({"id": "coop/Catch-v0"}, {"eviction": "best_returns:BestReturns"}),
    ],
)
def test_it_holds_what_the_table_draws(
    env: dict[str, Any], replay: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    run = saved(tmp_path, env={"id": "CartPole-v0", **env}, replay={**SMALL, **replay})
    table: Any = run.memory.table  # type: ignore[attr-defined]
    buffer = coop.load(tmp_path).buffer()
    assert len(buffer) == len(table) == 40
    assert (np.diff(buffer.ids) > 0).all()
    assert buffer.observations.shape == buffer.next_observations.shape == (40, *buffer.spec.obs_shape)
    row = {int(number): at for at, number in enumerate(buffer.ids)}
    before = {int(number): int(reuse) for number, reuse in zip(buffer.ids, buffer.reuse, strict=True)}
    batch = table.sample(400)
    at = np.array([row[int(number)] for number in batch.ids])
    shape = len(at), *buffer.spec.obs_shape
    np.testing.assert_array_equal(buffer.observations[at], batch.frames[batch.obs_index].reshape(shape))
    np.testing.assert_array_equal(buffer.next_observations[at], batch.frames[batch.next_index].reshape(shape))
    for name in ("actions", "rewards", "terminated", "span", "param_version", "age"):
        np.testing.assert_array_equal(getattr(buffer, name)[at], getattr(batch, name), name)
    draws = {int(number): int((batch.ids == number).sum()) for number in batch.ids}
    assert all(before[number] + draws[number] == reuse for number, reuse in zip(batch.ids, batch.reuse, strict=True))
    assert buffer.reuse.sum() > 0
    prioritized, by_episode = "sampling" in replay, "BestReturns" in replay["eviction"]
    assert (buffer.priority is not None) == prioritized
    if buffer.priority is not None:
        assert len(np.unique(buffer.priority)) > 5
    records = coop.load(tmp_path).episodes
    ends = records["env_step"].to_numpy()
    assert buffer.episode is not None
    assert buffer.episode.tolist() == [int((ends <= number).sum()) for number in buffer.ids]
    assert len(np.unique(buffer.episode)) > (3 if by_episode else 1)
    over = buffer.ids < ends[-1]
    assert not (buffer.terminated[~over]).any()
    assert buffer.truncated is not None
    assert not buffer.truncated.any(), "these games end by themselves"
    frame = buffer.frame()
    assert list(frame) == list(buffer.columns())
    np.testing.assert_array_equal(np.stack(list(frame["observations"])), buffer.observations)
    assert frame["actions"].tolist() == buffer.actions.tolist()


@pytest.mark.parametrize("n_step", [1, 3])
def test_it_says_which_transitions_were_truncated(n_step: int, tmp_path: Path) -> None:
    replay = {**SMALL, "capacity": 100, "n_step": n_step}
    saved(tmp_path, env={"id": "CartPole-v1", "max_episode_steps": 7}, replay=replay)
    buffer = coop.load(tmp_path).buffer()
    assert buffer.truncated is not None
    assert buffer.length is not None
    ends = coop.load(tmp_path).episodes["env_step"].to_numpy()
    assert len(ends) >= 9
    assert ends[:3].tolist() == [7, 14, 21], "too short to fall"
    cut = [number for number in buffer.ids if any(0 < end - number <= n_step for end in ends)]
    assert buffer.ids[buffer.truncated].tolist() == cut
    assert set(buffer.length[buffer.ids < ends[-1]]) == {7}


@pytest.mark.timeout(300)
def test_a_running_run_gives_its_buffer_and_goes_on(tmp_path: Path) -> None:
    run = coop.train(method="dqn", total_steps=10**6, run_dir=tmp_path, replay={**SMALL, "capacity": 10**6})
    try:
        first = run.buffer()
        again = coop.load(tmp_path).buffer(live=True)
        assert run.running
        assert len(again) > len(first) >= SMALL["learning_starts"]
        np.testing.assert_array_equal(again.observations[: len(first)], first.observations)
        assert not (tmp_path / "checkpoints" / "ASKED").exists()
    finally:
        run.stop()
    assert len(run.buffer()) == len(coop.load(tmp_path).buffer(live=True)) >= len(again), "of the closing checkpoint"


@pytest.mark.timeout(300)
def test_running_processes_give_their_buffer_and_go_on(tmp_path: Path) -> None:
    path = tmp_path / "run"
    flags = ("--method", "dqn", "--actors", "2", "--total-steps", "1000000", "--checkpoint-every", "1000000")
    table = ("--replay.capacity", "1000000", "--replay.learning-starts", "20")
    with Command("coop-local", *flags, *table, "--run-dir", path) as local:
        wait_for("some episodes", lambda: lines(path / "episodes.csv") > 4)
        first = coop.load(path).buffer(live=True)
        again = coop.load(path).buffer(live=True)
        before = lines(path / "episodes.csv")
        wait_for("the next episode", lambda: lines(path / "episodes.csv") > before)
        assert local.returncode is None
        assert not (path / "checkpoints" / "ASKED").exists()
        local.send_signal(signal.SIGINT)
        assert local.wait(60) == 130
    assert again.checkpoint > first.checkpoint > 0
    assert len(again) > len(first) > SMALL["learning_starts"]
    assert again.ids.tolist() == list(range(len(again)))
    assert again.reuse[: len(first)].sum() > first.reuse.sum()
    for name in ("observations", "actions", "rewards", "next_observations", "terminated", "param_version"):
        np.testing.assert_array_equal(getattr(again, name)[: len(first)], getattr(first, name), name)
    seen = {observation.tobytes() for observation in again.observations}
    goes_on = [each.tobytes() for each in again.next_observations[~again.terminated]]
    assert sum(each not in seen for each in goes_on) <= 2, "but for the newest step of each of two emulators"
    assert again.truncated is not None
    assert again.terminated.sum() > 2


def test_a_run_without_a_whole_table_is_refused(tmp_path: Path) -> None:
    saved(tmp_path, replay=SMALL)
    (frames,) = tmp_path.glob("checkpoints/*/replay/frames.npy")
    frames.write_bytes(frames.read_bytes()[:-1] + b"?")
    with pytest.raises(coop.UsageError, match=r"no complete checkpoint: .*frames.npy: wrong checksum"):
        coop.load(tmp_path).buffer()
    saved(tmp_path / "b", method="stream-q")
    with pytest.raises(coop.UsageError, match="has no buffer: method 'stream-q' learns from each transition once"):
        coop.load(tmp_path / "b").buffer()


@pytest.mark.parametrize("env", [{"id": "coop/Catch-v0"}, {"id": "CartPole-v0", "stack": 2}])
def test_a_parquet_file_gives_the_same_arrays(
    env: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("coop.evaluation.dataset.ROWS_AT_ONCE", 16)  # several groups, the last one smaller
    run, file = tmp_path / "run", tmp_path / "new" / "buffer.parquet"
    saved(run, env=env, replay={**SMALL, "sampling": "prioritized"})
    monkeypatch.setattr("sys.argv", ["coop-export", str(run), "--dataset", str(file)])
    export_cli.main()
    assert capsys.readouterr() == (f"checkpoint 50 in {run}: 40 transitions in {file}\n", "")
    assert [path.name for path in file.parent.iterdir()] == ["buffer.parquet"]
    buffer, table = coop.load(run).buffer(), pq.read_table(file)
    assert table.column_names == list(buffer.columns())
    assert table.schema.metadata[b"env_id"].decode() == env["id"]
    for name, array in buffer.columns().items():
        shape = json.loads(table.schema.field(name).metadata[b"shape"])
        read = np.array(table[name].to_pylist(), array.dtype).reshape(-1, *shape)
        np.testing.assert_array_equal(read, array, name, strict=True)


def test_a_data_set_replaces_nothing_and_is_whole_or_absent(tmp_path: Path, small_disk: Path) -> None:
    saved(tmp_path / "run", env={"id": "coop/Catch-v0"}, replay=SMALL)
    file = tmp_path / "mine"
    file.write_text("notes")
    with pytest.raises(UsageError, match="exists already"):
        export_dataset(tmp_path / "run", file)
    assert file.read_text() == "notes"
    with pytest.raises(UsageError, match="holds no run"):
        export_dataset(tmp_path, tmp_path / "a")
    (small_disk / "filler").write_bytes(bytes(shutil.disk_usage(small_disk).free - 4096))
    with pytest.raises(RunError, match=r"buffer\.parquet: No space left on device"):
        export_dataset(tmp_path / "run", small_disk / "buffer.parquet")
    assert [path.name for path in small_disk.iterdir()] == ["filler"]
