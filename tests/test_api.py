"""The Python API: training in the background, saved runs and their policies, evaluation, sweeps, registered methods."""

import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coop
from coop.common.settings.methods import METHODS
from coop.learner.losses import Values
from coop.learner.methods.rule import UpdateRule
from coop.lockstep import cli as lockstep_cli
from coop.studies.sweep.grid import Grid, GridFile

# Whole runs, also on a busy machine.
pytestmark = [pytest.mark.timeout(300), pytest.mark.usefixtures("quick_children")]

SMALL = {"learning_starts": 50, "capacity": 200}
NARROW = {"network": {"hidden": [16]}}


def trained(path: Path, method: str = "coop", **settings: Any) -> coop.TrainingRun:
    return coop.train(**{"method": method, "total_steps": 400, "run_dir": path, "replay": SMALL, **NARROW, **settings})


def test_a_run_in_the_background_gives_its_rows_and_its_summary(tmp_path: Path) -> None:
    signals = threading.active_count()
    run = trained(tmp_path / "a", seed=3, learner={"swap_every": 20})
    assert run.directory == tmp_path / "a"
    assert (run.config.seed, run.config.replay.capacity, run.config.learner.swap_every) == (3, 200, 20)
    rows = list(run.metrics())
    assert not run.running
    assert [row["update"] for row in rows] == sorted({row["update"] for row in rows})
    assert rows[-1]["update"] >= 200
    assert run.summary == run.wait()
    assert run.summary is not None
    assert (run.summary["env_steps"], run.summary["exit"]) == (400, "complete")
    assert list(run.metrics()) == rows
    assert threading.active_count() == signals


def test_training_equals_the_command_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained(tmp_path / "a", seed=1).wait()
    flags = [
        "--preset=cartpole",
        "--method=coop",
        "--seed=1",
        "--total-steps=400",
        "--replay.capacity=200",
        "--replay.learning-starts=50",
    ]
    monkeypatch.setattr("sys.argv", ["coop-lockstep", *flags, "--network.hidden=16", f"--run-dir={tmp_path}/b"])
    lockstep_cli.main()
    for name in ("config.toml", "episodes.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize("steps", [300.0, "300", "3e2", np.int64(300), np.float32(300)])
def test_whole_numbers_are_understood_before_others_follow_from_them(steps: Any, tmp_path: Path) -> None:
    call: dict[str, Any] = {"preset": "cartpole", "network": {"hidden": [8]}, "run_dir": tmp_path}
    run = coop.train(total_steps=steps, learner={"batch_size": np.uint8(32)}, **call)
    run.stop()
    plain = coop.train(total_steps=300, learner={"batch_size": 32}, overwrite=True, **call)
    plain.stop()
    assert run.config == plain.config
    assert (run.config.replay.learning_starts, run.config.planned_updates) == (30, 270)
    mine, other = (Grid(GridFile(fixed={"total_steps": each})).cells[0].config for each in (steps, 300))
    assert mine == other
    for wrong in (300.5, "many", 0, -(10**30), 10**400, True, float("nan")):
        with pytest.raises(coop.UsageError, match=r"^total_steps = .*: "):
            coop.train(**{**call, "total_steps": wrong, "overwrite": True})


def test_a_stopped_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    run = coop.train(method="dqn", total_steps=20_000, run_dir=tmp_path, replay=SMALL)
    next(run.metrics())
    summary = run.stop()
    assert summary is not None
    assert summary["exit"] == "stopped"
    steps = summary["env_steps"]
    assert 0 < steps < 20_000
    with pytest.raises(coop.UsageError, match=r"^run directory .*: holds a run already; .*resume=True in Python"):
        coop.train(method="dqn", total_steps=20_000, run_dir=tmp_path)
    again = coop.train(run_dir=tmp_path, resume=True)
    assert again.config == run.config
    summary = again.stop()
    assert summary is not None
    assert summary["env_steps"] >= steps


@pytest.mark.parametrize("distributed", [False, True])
def test_callbacks_get_each_row_once_and_may_stop_the_run(distributed: bool, tmp_path: Path) -> None:
    rows: dict[str, list[dict[str, Any]]] = {"on_metrics": [], "on_episode": [], "on_evaluation": []}
    calls: dict[str, Any] = {name: kept.append for name, kept in rows.items()}
    enough = 12  # which take more steps than a row of metrics
    calls["on_episode"] = lambda row: rows["on_episode"].append(row) or len(rows["on_episode"]) >= enough
    settings = {"total_steps": 20_000, "replay": SMALL, "eval_every": 40}
    run = coop.train(method="dqn", run_dir=tmp_path, distributed=distributed, **calls, **settings)
    summary = run.wait(200)
    assert summary is not None
    assert summary["exit"] == ("interrupted" if distributed else "stopped by on_episode")
    if not distributed:
        assert summary["episodes"] == enough
    saved = coop.load(tmp_path)
    assert [row["episode"] for row in rows["on_episode"]] == saved.episodes["episode"].tolist()
    assert [row["return"] for row in rows["on_episode"]] == saved.episodes["return"].tolist()
    assert [row["return_mean"] for row in rows["on_evaluation"]] == saved.evaluations["return_mean"].tolist()
    before, enough = len(rows["on_episode"]), len(rows["on_episode"]) + 12
    coop.train(run_dir=tmp_path, resume=True, distributed=distributed, **calls).wait(200)
    assert [row["episode"] for row in rows["on_episode"]] == coop.load(tmp_path).episodes["episode"].tolist()
    assert len(rows["on_episode"]) >= before + 12
    assert [row["update"] for row in rows["on_metrics"]] == coop.load(tmp_path).metrics["update"].tolist()


def test_rows_of_metrics_hold_returns_and_evaluations(tmp_path: Path) -> None:
    told: list[dict[str, Any]] = []
    run = coop.train(total_steps=700, run_dir=tmp_path, replay=SMALL, eval_every=300, on_metrics=told.append)
    rows = list(run.metrics())
    assert rows == told
    done = coop.load(tmp_path).evaluations.set_index("env_step")["return_mean"]
    assert list(done.index) == [300, 600]
    for row in rows:
        at = row["eval_env_step"]
        assert at == max((step for step in done.index if step < row["env_step"]), default=None)
        assert row["eval_return_mean"] == (None if at is None else done[at])
    assert {row["eval_env_step"] for row in rows} == {None, 300, 600}
    episodes = coop.load(tmp_path).episodes
    ended = episodes[episodes["env_step"] < rows[-1]["env_step"]]["return"]
    assert rows[-1]["return_mean_100"] == pytest.approx(ended.tail(100).mean())


def test_a_callback_that_fails_is_named(tmp_path: Path) -> None:
    with pytest.raises(coop.UsageError, match=r"^on_episode = 5: must be a function of a row"):
        trained(tmp_path, on_episode=5)
    run = trained(tmp_path, on_episode=lambda row: row["retrun"])
    with pytest.raises(coop.RunError, match=r"^on_episode: KeyError: 'retrun'$"):
        run.wait()
    summary = coop.load(tmp_path).summary
    assert summary is not None
    assert summary["exit"] == "failed: on_episode: KeyError: 'retrun'"
    assert summary["episodes"] == 1
    assert coop.train(run_dir=tmp_path, resume=True).wait()["exit"] == "complete"  # type: ignore[index]


def test_bad_settings_are_refused_before_anything_starts(tmp_path: Path) -> None:
    for settings, text in (
        ({"replay": {"size": 5}}, "replay.size = 5: no such field"),
        ({"replay": 5}, "replay = 5: must be a table"),
        ({"sede": 5}, "sede = 5: no such field"),
        ({"preset": "x"}, "preset = 'x': unknown"),
        ({"method": "dqqn"}, "did you mean dqn\\?"),
        ({"actors": 2}, "in distributed runs only"),
        ({"actors": 0, "distributed": True}, "at least 1"),
        ({"env": {"id": "Nowhere-v0"}}, "Nowhere-v0"),
    ):
        with pytest.raises(coop.UsageError, match=text):
            coop.train(run_dir=tmp_path / "a", **settings)  # type: ignore[arg-type]
    assert not (tmp_path / "a").exists()
    with pytest.warns(UserWarning, match="edl.rate has no effect: dqn"):
        coop.train(method="dqn", total_steps=40, run_dir=tmp_path / "b", edl={"rate": 0.5}).wait()


def test_a_run_that_diverges_says_so_at_its_end(tmp_path: Path) -> None:
    run = trained(tmp_path, learner={"learning_rate": 1e30})
    with pytest.raises(coop.RunError, match="diverged: "):
        list(run.metrics())
    assert run.summary is not None
    assert run.summary["exit"].startswith("diverged")


def test_a_distributed_run(tmp_path: Path) -> None:
    run = trained(tmp_path / "a", distributed=True, actors=2)
    rows = list(run.metrics())
    assert rows
    assert run.summary is not None
    assert (run.summary["exit"], run.summary["transitions_lost"]) == ("complete", 0)
    assert sorted(path.name for path in (tmp_path / "a" / "logs").glob("actor-*")) == ["actor-1.log", "actor-2.log"]
    buffer = coop.load(tmp_path / "a").buffer()
    assert 0 < len(buffer) <= run.config.replay.capacity
    assert (np.abs(buffer.observations[:, 0]) < 2.5).all()  # metres, of CartPole's track
    assert not np.array_equal(buffer.observations, buffer.next_observations)


def test_a_distributed_run_that_can_t_start_says_why(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "logs").write_text("in the way")
    with pytest.raises(coop.RunError, match="File exists"):
        trained(tmp_path / "a", distributed=True)
    run = trained(tmp_path / "b", distributed=True, network={"hidden": [10**7, 10**7]})
    with pytest.raises(coop.RunError, match=r"coop-local ended .exit status 2.: .*network.hidden"):
        run.wait()


def test_a_saved_run_and_its_policies(tmp_path: Path) -> None:
    trained(tmp_path).wait()
    saved = coop.load(tmp_path)
    assert saved.config.method == "coop"
    assert saved.episodes["length"].sum() <= 400
    assert saved.episodes["env_step"].is_monotonic_increasing
    assert saved.metrics["update"].tolist() == [row["update"] for row in saved.metrics.to_dict("records")]
    obs = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    one, two, mean = (saved.policy(network).q_values(obs) for network in (1, 2, "mean"))  # type: ignore[arg-type]
    assert one.shape == two.shape == (5, 2)
    assert np.abs(one - two).max() > 1e-3
    np.testing.assert_allclose(mean, (one + two) / 2, rtol=1e-6)
    np.testing.assert_array_equal(saved.q_values(obs[0], 2), saved.policy(2).q_values(obs[0]))
    policy = saved.policy()
    np.testing.assert_array_equal(policy(obs), mean.argmax(1))
    assert policy(obs[2].tolist()) == mean[2].argmax()
    assert isinstance(policy(obs[2]), int)
    for wrong in (obs[:, :3], obs[0, :3], obs[None]):
        with pytest.raises(coop.UsageError, match="CartPole-v0 has 4"):
            policy(wrong)
    with pytest.raises(coop.UsageError, match="allowed: 'mean', 1, 2"):
        saved.policy(3)  # type: ignore[arg-type]


def test_the_mean_of_one_network_is_that_network(tmp_path: Path) -> None:
    trained(tmp_path, "dqn", learner={"target_update_every": 1000}).wait()
    saved, obs = coop.load(tmp_path), np.ones(4, np.float32)
    assert saved.q_values(obs).tolist() == saved.q_values(obs, 1).tolist() != saved.q_values(obs, 2).tolist()


def test_folders_without_a_run_or_a_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(coop.UsageError, match="holds no run"):
        coop.load(tmp_path)
    run = trained(tmp_path / "a")
    run.wait()
    for path in (tmp_path / "a" / "checkpoints").glob("*/DONE"):
        path.unlink()
    with pytest.raises(coop.UsageError, match="no complete checkpoint"):
        coop.load(tmp_path / "a").policy()


def test_evaluation_in_the_policy_s_own_environment_and_in_others(tmp_path: Path) -> None:
    trained(tmp_path, env={"max_episode_steps": 7}).wait()
    policy = coop.load(tmp_path).policy()
    assert coop.evaluate(policy, 5).returns == [7.0] * 5
    assert max(coop.evaluate(policy, 5, env={"max_episode_steps": 6}).returns) == 6.0
    left = coop.evaluate(lambda obs: 0, 20, env="CartPole-v0", seed=1)
    assert 8 <= min(left.returns) <= left.mean <= max(left.returns) <= 11
    assert left == coop.evaluate(lambda obs: [0], 20, env="CartPole-v0", seed=1)
    assert left.sd == pytest.approx(np.std(left.returns))
    with pytest.raises(coop.UsageError, match="env: "):
        coop.evaluate(lambda obs: 0, 20)
    with pytest.raises(coop.UsageError, match="episodes = 0"):
        coop.evaluate(policy, 0)


def test_a_sweep(tmp_path: Path) -> None:
    grid = {
        "methods": ["dqn", "coop"],
        "fixed": {"total_steps": 200, "replay": {"learning_starts": 50}},
        "vary": {"replay": {"capacity": [60, 100]}},
    }
    done = coop.sweep(grid, tmp_path, jobs=2)
    assert done.failed == {}
    assert sorted(done.runs["replay.capacity"]) == [60, 60, 100, 100]
    assert set(done.runs["method"]) == {"dqn", "coop"}
    assert set(done.runs["exit"]) == {"complete"}
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("summary.json")}
    assert len(before) == 4
    (cell, *_) = sorted(path.name for path in tmp_path.glob("*seed*"))
    shutil.copytree(tmp_path / cell, tmp_path / "a copy")  # the user's own, as are notes in any form
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "config.toml").write_text("[")
    assert cell in set(coop.load_sweep(tmp_path).episodes["run"])
    assert set(coop.load_sweep(tmp_path).episodes["run"]).isdisjoint({"a copy", "notes"})
    assert coop.sweep(grid, tmp_path).runs.equals(done.runs)
    assert before.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.rglob("summary.json")}.items()
    with pytest.raises(coop.UsageError, match="give another --dir"):
        coop.sweep({**grid, "fixed": {"total_steps": 300}}, tmp_path)
    with pytest.raises(coop.UsageError, match="jobs = 0"):
        coop.sweep(grid, tmp_path, jobs=0)


class Pessimist(UpdateRule):
    """Targets bootstrap from the worst action."""

    def bootstrap(self, next_values: Values, preferred: Values) -> Values:
        worst: Values = next_values.min(1)
        return worst


def test_a_registered_method_trains(tmp_path: Path) -> None:
    coop.register_method(replace(METHODS.get("dqn"), name="pessimist", rule=Pessimist, colour=None))
    with pytest.raises(coop.UsageError, match="there is one of that name already"):
        coop.register_method(METHODS.get("dqn"))
    run = trained(tmp_path, "pessimist", learner={"target_update_every": 10})
    run.wait()
    plain = trained(tmp_path / "b", "dqn", learner={"target_update_every": 10})
    plain.wait()
    values = [coop.load(path).metrics["q_abs_mean"].iloc[-1] for path in (tmp_path, tmp_path / "b")]
    assert values[0] < values[1]


def test_a_script_from_standard_input_waits_for_its_runs(tmp_path: Path) -> None:
    script = "import coop\nfor distributed in (False, True):\n"
    script += "    coop.train(total_steps=300, run_dir=str(distributed), distributed=distributed)\nprint('at once')\n"
    done = subprocess.run(
        [sys.executable, "-"], input=script, capture_output=True, text=True, timeout=250, check=True, cwd=tmp_path
    )
    *settings, printed = done.stdout.splitlines()
    assert len(settings) == 2
    for line in settings:
        assert line.startswith("settings: preset cartpole; method: coop; gamma: 0.95; replay: capacity 5,000, ")
    assert (printed, done.stderr) == ("at once", "")
    for distributed in (False, True):
        summary = coop.load(tmp_path / str(distributed)).summary
        assert summary is not None
        assert summary["exit"] == "complete"


def test_a_script_that_fails_stops_its_run(tmp_path: Path) -> None:
    script = f"import coop\nrun = coop.train(run_dir={str(tmp_path / 'a')!r})\nnext(run.metrics())\n1 / 0\n"
    done = subprocess.run(
        [sys.executable, "-"], input=script, capture_output=True, text=True, timeout=100, check=False, cwd=tmp_path
    )
    assert done.returncode == 1
    assert done.stderr.endswith("ZeroDivisionError: division by zero\n")
    summary = coop.load(tmp_path / "a").summary
    assert summary is not None
    assert summary["exit"] == "stopped"
