"""Runs that begin with a data set in their table, or learn from it alone; and what data sets are refused."""

from __future__ import annotations

import dataclasses
import json
import os
import runpy
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import run_command
from test_buffer import SMALL, saved

import coop
from coop.common.envs.make import env_spec
from coop.common.errors import UsageError
from coop.common.process.lifecycle import Stop
from coop.common.settings.tables import resolve
from coop.evaluation.dataset import export_dataset, export_to
from coop.lockstep.run import LockstepRun
from coop.records import datasets
from coop.records.parquet_seals import SEAL
from coop.records.resumption import Start

pytestmark = pytest.mark.timeout(300)
NETWORK = {"kind": "mlp", "hidden": [8]}
SAME = ("observations", "next_observations", "actions", "rewards", "terminated", "span")


def config_of(data: Path, **tables: Any) -> Any:
    replay = {"capacity": 300, "learning_starts": 20, "preload": str(data), **tables.pop("replay", {})}
    return resolve({"method": "coop", "network": NETWORK, "total_steps": 120, **tables, "replay": replay})


def played(config: Any, path: Path, *, resume: bool = False, steps: int | None = None) -> LockstepRun:
    """Play a lockstep run to its end, or stop it after so many steps."""
    stop = Stop()
    with closing(LockstepRun(config, path, "test", Start(resume=resume), log="none")) as run:
        step = run.run.memory.batches

        def batches(at: int) -> Any:
            if steps is not None and at >= steps:
                stop.set("stopped")
            return step(at)

        run.run.memory.batches = batches  # type: ignore[method-assign]
        run.play(stop)
    return run


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 transitions of CartPole-v0, of a table that had evicted some."""
    folder = tmp_path_factory.mktemp("data")
    saved(folder / "run", replay=SMALL)
    export_dataset(folder / "run", folder / "data.parquet")
    return folder / "data.parquet"


@pytest.mark.parametrize("env", [{"id": "coop/Catch-v0", "stack": 2}, {"id": "CartPole-v0"}, {"id": "gates:Gates-v0"}])
def test_a_table_begins_with_a_data_set(env: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(datasets, "ROWS", 16)
    monkeypatch.setattr("coop.evaluation.dataset.ROWS_AT_ONCE", 24)
    saved(tmp_path / "run", env=env, replay=SMALL)
    export_dataset(tmp_path / "run", tmp_path / "data.parquet")
    run = played(config_of(tmp_path / "data.parquet", env=env), tmp_path / "b")
    assert run.notices == [f"the table begins with 40 transitions of {tmp_path}/data.parquet"]
    given, buffer = coop.load(tmp_path / "run").buffer(), coop.load(tmp_path / "b").buffer()
    assert len(buffer) == 160
    assert (buffer.mask is not None) == (env["id"] == "gates:Gates-v0")
    for name in (*SAME, *(() if buffer.mask is None else ("mask", "next_mask"))):
        np.testing.assert_array_equal(getattr(buffer, name)[:40], getattr(given, name), name, strict=True)
    assert buffer.age[0] == 159
    assert buffer.reuse[:40].sum() > 0
    assert buffer.episode is not None
    assert (buffer.episode[:40] == -1).all()
    assert buffer.episode[40] == 0
    summary = coop.load(tmp_path / "b").summary
    assert summary is not None
    assert (summary["env_steps"], summary["updates"], summary["transitions_accepted"]) == (120, 100, 120)
    assert coop.load(tmp_path / "b").episodes["env_step"].max() <= 120
    counters = run.run.memory.counters()
    assert (counters["size"], counters["evicted"], counters["evicted_unsampled"]) == (160, 0, 0)


def test_a_data_set_without_masks_is_none_of_an_environment_with_them(tmp_path: Path) -> None:
    saved(tmp_path / "run", env={"id": "gates:Gates-v0"}, replay=SMALL)
    export_dataset(tmp_path / "run", tmp_path / "data.parquet")
    pq.write_table(pq.read_table(tmp_path / "data.parquet").drop_columns("next_mask"), tmp_path / "less.parquet")
    with pytest.raises(UsageError, match=r"less\.parquet'?: has no column next_mask; needed: .*, mask, next_mask"):
        played(config_of(tmp_path / "less.parquet", env={"id": "gates:Gates-v0"}), tmp_path / "b")


def test_a_table_that_is_too_small_evicts_before_the_run_begins(data: Path, tmp_path: Path) -> None:
    run = LockstepRun(config_of(data, replay={"capacity": 30}), tmp_path, "test", Start(), log="none")
    table: Any = run.run.memory.table  # type: ignore[attr-defined]
    run.close()
    assert run.notices == [f"the table begins with 40 transitions of {data}, of which it keeps 30"]
    assert (len(table), table.preloaded, table.inserted, table.evicted, table.evicted_unsampled) == (30, 40, 0, 0, 0)


@pytest.mark.parametrize("offline", [False, True])
def test_it_goes_on_to_the_bit_without_the_data_set(offline: bool, data: Path, tmp_path: Path) -> None:
    copied = tmp_path / "copy.parquet"
    copied.write_bytes(data.read_bytes())
    config = config_of(copied, replay={"offline": offline, "sampling": "prioritized"}, eval_every=50, eval_episodes=2)
    played(config, tmp_path / "whole")
    played(config, tmp_path / "two", steps=70)
    assert coop.load(tmp_path / "two").summary["exit"] == "stopped"  # type: ignore[index]
    copied.unlink()
    played(config, tmp_path / "two", resume=True)
    states = [coop.load(tmp_path / name).checkpoint() for name in ("whole", "two")]
    assert states[0].number == states[1].number == (120 if offline else 100)
    for first, second in zip(states[0].networks, states[1].networks, strict=True):
        np.testing.assert_array_equal(first.snapshot(), second.snapshot())
    assert (tmp_path / "whole" / "episodes.csv").read_bytes() == (tmp_path / "two" / "episodes.csv").read_bytes()
    first, second = (coop.load(tmp_path / name).evaluations.drop(columns="seconds") for name in ("whole", "two"))
    assert first["env_step"].tolist() == [50, 100]
    assert first.equals(second)


def test_an_offline_run_plays_nothing_and_is_evaluated(data: Path, tmp_path: Path) -> None:
    run = coop.train(
        "cartpole",
        "dqn",
        actors=0,
        total_steps=200,
        run_dir=tmp_path / "a",
        replay={"preload": str(data), "ratio": 2, "capacity": 100},
        eval_every=100,
        eval_episodes=3,
        log="none",
    )
    assert run.config.replay.offline
    summary = run.wait()
    assert summary is not None
    assert (summary["exit"], summary["env_steps"], summary["updates"], summary["episodes"]) == ("complete", 0, 400, 0)
    saved_run = coop.load(tmp_path / "a")
    assert saved_run.evaluations["update"].tolist() == [200, 400]
    assert len(saved_run.buffer()) == 40
    assert saved_run.buffer().reuse.sum() == 400 * run.config.learner.batch_size
    assert saved_run.buffer().truncated is None, "the data set's are not kept"
    with closing(LockstepRun(run.config, tmp_path / "b", "test", Start(), log="none")) as other:
        assert [other.run.memory.due(step) for step in (0, 1, 100)] == [0, 2, 200]  # type: ignore[attr-defined]


@pytest.mark.timeout(600)
def test_a_run_of_processes_begins_with_it_and_can_be_repeated(data: Path, tmp_path: Path) -> None:
    common = (
        "--network.hidden=8",
        f"--replay.preload={data}",
        "--replay.journal",
        "--replay.journal-keep",
        "--log=none",
    )
    run = tmp_path / "run"
    done = run_command("coop-local", "--preset=cartpole", *common, "--total-steps=300", "--run-dir", run, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    log = (run / "logs" / "replay.log").read_text()
    assert f"the table begins with 40 transitions of {data}" in log
    buffer = coop.load(run).buffer()
    np.testing.assert_array_equal(buffer.observations[:40], coop.load(data.parent / "run").buffer().observations)
    again = run_command("coop-reexecute", run, timeout=120)
    assert (again.returncode, again.stderr) == (0, "")
    assert "parameters, optimizers and random state equal" in again.stdout


@pytest.mark.timeout(600)
def test_processes_learn_offline_and_another_data_set_is_named(data: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.parquet"
    own.write_bytes(data.read_bytes())
    common = (
        "--network.hidden=8",
        f"--replay.preload={own}",
        "--replay.journal",
        "--replay.journal-keep",
        "--log=none",
    )
    run = tmp_path / "run"
    flags = ("--actors=0", "--total-steps=300", "--eval-every=150", "--eval-episodes=2", "--replay.ratio=0.5")
    done = run_command("coop-local", "--preset=cartpole", *common, *flags, "--run-dir", run, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not list(run.glob("logs/actor*"))
    summary = coop.load(run).summary
    assert summary is not None
    assert (summary["exit"], summary["env_steps"], summary["updates"]) == ("complete", 0, 150)
    assert coop.load(run).evaluations["env_step"].tolist()[-1] == 300
    assert run_command("coop-reexecute", run, timeout=120).returncode == 0
    rewards = pq.read_table(own)
    changed = rewards.set_column(
        rewards.column_names.index("rewards"), "rewards", pa.array(np.full(len(rewards), 0.5, np.float32))
    )
    pq.write_table(changed, own)
    again = run_command("coop-reexecute", run, timeout=120)
    assert again.returncode == 1
    assert again.stderr.endswith(f"replay.preload = '{own}': not the data set that the run began with\n")
    assert again.stderr.count("\n") == 1


@pytest.mark.parametrize("capacity", [100, 40])
def test_whole_episodes_come_back_from_minari_as_they_were(capacity: int, tmp_path: Path) -> None:
    run = tmp_path / "run"
    saved(run, env={"id": "CartPole-v1", "max_episode_steps": 12}, replay={**SMALL, "capacity": capacity})
    told = export_to(run, tmp_path / "episodes")
    buffer, ends = coop.load(run).buffer(), [0, *coop.load(run).episodes["env_step"].tolist()]
    first = min(end for end in ends if end >= buffer.ids[0])
    ends = [end for end in ends if end >= first]
    steps = ends[-1] - first
    assert (first > buffer.ids[0]) == (capacity == 40), "one episode has been evicted in part"
    assert told == (
        f"{run}: {len(ends) - 1} whole episodes of checkpoint 50, {steps} transitions, in {tmp_path}/episodes"
    )
    found = list(minari.MinariDataset(tmp_path / "episodes" / "data").iterate_episodes())
    assert [len(episode) for episode in found] == np.diff(ends).tolist()
    last = np.searchsorted(buffer.ids, np.array(ends[1:]) - 1)
    assert [bool(episode.terminations[-1]) for episode in found] == buffer.terminated[last].tolist()
    assert [bool(episode.truncations[-1]) for episode in found] == (~buffer.terminated[last]).tolist()
    played(config_of(tmp_path / "episodes", env={"id": "CartPole-v1"}), tmp_path / "b")
    again, begin = coop.load(tmp_path / "b").buffer(), int(np.searchsorted(buffer.ids, first))
    for name in SAME:
        read, given = getattr(again, name)[:steps], getattr(buffer, name)[begin : begin + steps]
        np.testing.assert_array_equal(read, given, name, strict=True)


@pytest.mark.timeout(600)
def test_a_kept_journal_gives_all_whole_episodes(tmp_path: Path) -> None:
    run = tmp_path / "run"
    journal = ("--replay.journal", "--replay.journal-keep", "--replay.capacity=40", "--replay.learning-starts=20")
    flags = ("--env.id=coop/Catch-v0", "--env.stack=2", "--actor.num-envs=3", "--total-steps=300", "--log=none")
    done = run_command("coop-local", *flags, *journal, "--run-dir", run, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    told = export_to(run, tmp_path / "episodes")
    episodes = coop.load(run).episodes
    assert " whole episodes of its journal, " in told
    found = list(minari.MinariDataset(tmp_path / "episodes" / "data").iterate_episodes())
    lengths, returns = [len(each) for each in found], [float(each.rewards.sum()) for each in found]
    ended = Counter(zip(episodes["length"], episodes["return"], strict=True))
    assert Counter(zip(lengths, returns, strict=True)) <= ended
    assert len(found) >= len(episodes) - 6, "at a run's end a segment of each stream may be refused, and the next not"
    spec = env_spec(coop.load(run).config.env)
    rows = [row for each in datasets.read_rows(tmp_path / "episodes", spec, "x") for row in each.obs]
    held = {(obs.tobytes(), following.tobytes()) for obs, following in _pairs(coop.load(run).buffer())}
    exported = {(each.tobytes(), after.tobytes()) for episode in found for each, after in _steps(episode)}
    assert len(rows) == sum(lengths)
    unfinished = 3 * max(lengths)
    assert len(held - exported) <= unfinished
    assert len(held & exported) >= len(held) // 3


def _pairs(buffer: Any) -> Any:
    return zip(buffer.observations, buffer.next_observations, strict=True)


def _steps(episode: Any) -> Any:
    return zip(episode.observations[:-1], episode.observations[1:], strict=True)


def test_where_no_episode_is_whole_it_is_parquet(tmp_path: Path) -> None:
    run = tmp_path / "run"
    saved(run, replay={**SMALL, "eviction": "reservoir", "n_step": 2})
    told = export_to(run, tmp_path / "a")
    assert told == (
        f"checkpoint 50 in {run}: 40 transitions in {tmp_path}/a/transitions.parquet, not as episodes of Minari: its "
        "transitions sum 2 rewards, replay.n_step"
    )
    assert played(config_of(tmp_path / "a"), tmp_path / "b").notices[0].startswith("the table begins with 40")
    with pytest.raises(UsageError, match="exists already; name a new folder"):
        export_to(run, tmp_path / "a")


def columns(**changed: Any) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    plain = {
        "observations": pa.array(rng.normal(size=(30, 4)).astype("f4").tolist(), pa.list_(pa.float32(), 4)),
        "next_observations": pa.array(rng.normal(size=(30, 4)).astype("f4").tolist(), pa.list_(pa.float32())),
        "actions": pa.array(rng.integers(2, size=30)),
        "rewards": pa.array(np.ones(30)),
        "terminated": pa.array(np.zeros(30, bool)),
    }
    return {name: value for name, value in {**plain, **changed}.items() if value is not None}


OBS = columns()["observations"]


def first_changed(value: object) -> pa.Array:
    rows = OBS.to_pylist()
    rows[3] = [value] * 4
    return pa.array(rows, pa.list_(pa.float32(), 4))


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"actions": pa.array([2] * 30)}, "actions: 2 to 2; allowed: integers from 0 to 1"),
        ({"actions": pa.array([0.0] * 30)}, "actions: double; allowed|actions: float64; allowed: integers"),
        ({"actions": None}, "has no column actions; needed: observations"),
        ({"rewards": pa.array([1e9] * 30)}, "transitions 0 to 29: rewards: values from 1000000000.0 to 1000000000.0"),
        ({"rewards": pa.array(["a"] * 30)}, "column rewards: holds no numbers"),
        ({"rewards": pa.array([1.0] * 29 + [None])}, "column rewards: has rows without a value"),
        ({"terminated": pa.array([0.5] * 30)}, "terminated: float64; allowed: bool"),
        ({"observations": first_changed(float("nan"))}, "transitions 0 to 29: frames: values from nan"),
        ({"observations": first_changed(None)}, "column observations: has rows without a value"),
        ({"observations": pa.array([[1.0] * 5] * 30)}, "column observations: rows of 5 values; an observation of Cart"),
        ({"observations": pa.array([[1.0] * 4] * 29 + [[1.0] * 3])}, "column observations: rows of 3 values"),
        ({"observations": pa.array([[[1.0] * 4]] * 30)}, "column observations: "),
        ({"span": pa.array([0] * 30)}, "span: 0 to 0; allowed: integers from 1 to 100"),
    ],
)
def test_another_s_file_is_refused_in_a_line(changed: dict[str, Any], why: str, tmp_path: Path) -> None:
    file = tmp_path / "data.parquet"
    pq.write_table(pa.table(columns()), file)
    config = config_of(file)
    spec = env_spec(config.env)
    assert sum(len(rows.actions) for rows in datasets.read_rows(file, spec, "x")) == 30
    pq.write_table(pa.table(columns(**changed)), file)
    with pytest.raises(UsageError, match=f"^replay.preload = '{file}': ({why})") as refused:
        LockstepRun(config, tmp_path / "run", "test", Start(), log="none")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "run" / "config.toml").exists()


def test_a_changed_bit_of_a_data_set_is_named(data: Path, tmp_path: Path) -> None:
    content, file, spec = data.read_bytes(), tmp_path / "data.parquet", env_spec(config_of(data).env)
    last = len(content) - int.from_bytes(content[-8:-4], "little") - 8  # of the pages
    for at in (*range(10, last, last // 20), last + 50, len(content) - 6):
        changed = bytearray(content)
        changed[at] ^= 1
        file.write_bytes(changed)
        with pytest.raises(UsageError, match=r"^x: wrong checksum: not what was exported$"):
            datasets.check_data_set(file, spec, "x")
    file.write_bytes(changed := content.replace(b"crc32 of the rest", b"crc33 of the rest"))
    assert changed != content
    page = bytearray(changed)
    page[last // 2] ^= 1
    file.write_bytes(page)
    with pytest.raises(UsageError, match=r"^x: "):
        list(datasets.read_rows(file, spec, "x"))
    pq.write_table(pq.read_table(data).slice(0, 9), file)
    assert SEAL.encode() in pq.read_schema(file).metadata, "what a user has made of it"
    assert [len(rows.actions) for rows in datasets.read_rows(file, spec, "x")] == [9]


@pytest.mark.parametrize("name", ["data", "data.parquet"])
def test_an_export_is_on_the_disk_before_its_name_and_spares_other_s_parts(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved(tmp_path / "run", replay=SMALL)
    synced: set[str] = set()
    fsync, rename = os.fsync, Path.replace

    def noted(descriptor: int) -> None:
        synced.add(str(Path(f"/proc/self/fd/{descriptor}").readlink()))
        fsync(descriptor)

    def renamed(path: Path, target: Path) -> Path:
        if target == tmp_path / name:
            assert {str(each) for each in (path, *path.rglob("*"))} <= synced
        return rename(path, target)

    (tmp_path / f"{name}.part").mkdir()
    (tmp_path / f"{name}.part" / "mine").write_text("to keep")
    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(Path, "replace", renamed)
    export_to(tmp_path / "run", tmp_path / name)
    assert str(tmp_path) in synced
    assert (tmp_path / f"{name}.part" / "mine").read_text() == "to keep"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, f"{name}.part", "run"])


def test_a_row_group_that_takes_more_memory_than_allowed_is_refused_unread(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Thousands of equal rows take almost no space in a file."""
    rows = 40_000
    many = pa.table(
        {
            "observations": pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(rows * 4, "f4")), 4),
            "next_observations": pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(rows * 4, "f4")), 4),
            "actions": pa.array(np.zeros(rows, "i8")),
            "rewards": pa.array(np.zeros(rows, "f4")),
            "terminated": pa.array(np.zeros(rows, bool)),
        }
    )
    file = tmp_path / "data.parquet"
    pq.write_table(many, file, row_group_size=rows, compression="zstd")
    monkeypatch.setattr(datasets, "MAX_AT_ONCE", 1 << 20)
    assert file.stat().st_size < 1 << 15
    spec = env_spec(config_of(file).env)
    with monkeypatch.context() as patch:
        patch.setattr(datasets, "_checked", lambda *given: pytest.fail("it has been read"))
        with pytest.raises(UsageError, match=r"^x: row group 0 takes 1,\d{3},\d{3} bytes; allowed: at most 1,048,576$"):
            list(datasets.read_rows(file, spec, "x"))
    assert list(datasets.read_rows(data, spec, "x"))


def minari_file(folder: Path, **changed: Any) -> Path:
    (folder / "data").mkdir(parents=True)
    plain = {
        "observations": np.zeros((4, 4), "f4"),
        "actions": np.array([0, 1, 1]),
        "rewards": np.ones(3),
        "terminations": np.array([False, False, True]),
        "truncations": np.zeros(3, bool),
    }
    with h5py.File(folder / "data" / "main_data.hdf5", "w") as file:
        for name, value in {**plain, **changed}.items():
            if callable(value):
                value(file)
            elif value is not None:
                file[f"episode_0/{name}"] = value
    return folder


def _link(file: Any) -> None:
    file["episode_0/rewards"] = h5py.ExternalLink("/etc/passwd", "/")


def _virtual(file: Any) -> None:
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource("other.hdf5", "x", shape=(3,))
    file.create_virtual_dataset("episode_0/rewards", layout)


def _huge(file: Any) -> None:
    file.create_dataset("episode_0/rewards", (2**40,), "f8", chunks=(2**28,))


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"rewards": None}, "episode_0/rewards: missing, or a link"),
        ({"rewards": _link}, "episode_0/rewards: missing, or a link"),
        ({"rewards": _virtual}, "episode_0/rewards: lies in other files"),
        ({"rewards": _huge}, "episode_0/rewards: shape .*; too large to read"),
        ({"observations": np.zeros((3, 4), "f4")}, r"episode_0/observations: float32 \(3, 4\); CartPole-v0: \(4, 4\)"),
        ({"observations": None, "observations/a": np.zeros(3)}, "episode_0/observations: no dataset; Dict and Tuple"),
        ({"actions": np.array([0, 1, 2])}, "actions: 0 to 2; allowed: integers from 0 to 1"),
        ({"actions": np.zeros((3, 2))}, r"episode_0/actions: float64 \(3, 2\)"),
        ({"rewards": np.array([1, np.nan, 1])}, "transitions 0 to 2: rewards: values from nan"),
    ],
)
def test_another_s_minari_data_set_is_refused_in_a_line(changed: dict[str, Any], why: str, tmp_path: Path) -> None:
    good, bad = minari_file(tmp_path / "good"), minari_file(tmp_path / "bad", **changed)
    LockstepRun(config_of(good), tmp_path / "run", "test", Start(), log="none").close()
    with pytest.raises(UsageError, match=f"^replay.preload = '{bad}': ({why})") as refused:
        LockstepRun(config_of(bad), tmp_path / "run", "test", Start(), log="none")
    assert "\n" not in str(refused.value)


def test_a_discrete_space_may_begin_elsewhere(tmp_path: Path) -> None:
    folder = minari_file(tmp_path / "a", actions=np.array([5, 6, 6]))
    space = json.dumps({"type": "Discrete", "dtype": "int64", "start": 5, "n": 2})
    (folder / "data" / "metadata.json").write_text(json.dumps({"action_space": space}))
    (rows,) = datasets.read_rows(folder, env_spec(config_of(folder).env), "x")
    assert rows.actions.tolist() == [0, 1, 1]
    assert rows.ends.tolist() == [False, False, True]


def test_the_example_trains_offline_from_its_own_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["offline.py", f"--folder={tmp_path}", "--steps=400"])
    runpy.run_path(str(Path(__file__).parents[1] / "examples" / "offline.py"), run_name="__main__")
    summary = coop.load(tmp_path / "offline").summary
    assert summary is not None
    assert (summary["env_steps"], summary["updates"], summary["exit"]) == (0, 400, "complete")
    assert len(coop.load(tmp_path / "offline").evaluations) == 4


def test_settings_that_contradict_each_other_are_refused(data: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"^replay.offline = True: needs the data set .*replay.preload$"):
        resolve({"replay": {"offline": True}})
    with pytest.raises(UsageError, match=r"^replay.preload = 'x': not for method 'stream-q'"):
        resolve({"method": "stream-q", "replay": {"preload": "x"}})
    with pytest.raises(UsageError, match=r"^replay.preload = .*nothing.*: does not exist$"):
        LockstepRun(config_of(tmp_path / "nothing"), tmp_path / "run", "test", Start(), log="none")
    with pytest.raises(coop.UsageError, match=r"^actors = 0: must be at least 1, or 0 with replay.preload$"):
        coop.train(distributed=True, actors=0, run_dir=tmp_path / "b")
    config = resolve({"replay": {"preload": str(data)}})
    assert config.replay.learning_starts == 1
    with pytest.warns(UserWarning, match=r"actor.epsilon-start has no effect: nobody acts, replay.offline"):
        run = coop.train(
            actors=0,
            total_steps=40,
            run_dir=tmp_path / "c",
            actor={"epsilon_start": 0.5},
            replay={"preload": str(data)},
        )
    assert run.wait()["updates"] == 40  # type: ignore[index]
    assert dataclasses.replace(config.replay, offline=True).preload == str(data)
