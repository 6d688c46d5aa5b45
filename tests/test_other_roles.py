"""Faults that one role, command or function showed first, in the others that could share them."""

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from commands import run_command, run_for_a_line
from test_environment_promises import ODD, SHORT, Odd, inner

import coop
from coop.common.envs import gymnasium_env
from coop.common.envs.make import make_filmed_env, make_vector_env
from coop.common.errors import CoopError, RunError, UsageError
from coop.common.process import output
from coop.common.process.processes import command
from coop.common.settings.environment import EnvSettings
from coop.evaluation import film as film_module
from coop.evaluation.episodes import Evaluator
from coop.evaluation.film import Film, short_gif
from coop.evaluation.saved import SavedRun
from coop.learner.agent import Agent

pytestmark = pytest.mark.timeout(300)  # several processes a test, also on a busy machine

SMALL = ["--total-steps", "300", "--replay.capacity", "100", "--replay.learning-starts", "40", "--network.hidden", "8"]
MINE = ["--allow-import", "odd_envs"]  # the run is copied, with the module
PLAYED = ["--episodes", "1", "--networks", "1", *MINE]
ENVS = """
import os, sys, threading, time
import gymnasium
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv

ASSETS = os.path.abspath("assets")
class Odd(CartPoleEnv):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        what = os.environ.get("ODD", "")
        if what == "directory":
            os.chdir(ASSETS)
        if what == "streams":
            sys.stdout = sys.stderr = None
        if what == "thread":
            threading.Thread(target=time.sleep, args=(300,), name="viewer").start()
    def render(self):
        return np.zeros((20, 20, 3), np.uint8)
    def step(self, action):
        if os.environ.get("ODD") == "exit":
            sys.exit("no licence")
        if os.environ.get("ODD") == "closed window":
            raise KeyboardInterrupt("window closed")
        obs, reward, *ends = super().step(action)
        return (obs, 123456.789 if os.environ.get("ODD") == "rewards" else reward, *ends)

gymnasium.register("Odd-v0", entry_point=Odd, max_episode_steps=12)
"""
GRID = """
methods = ["dqn"]
seeds = [0, 1]
[fixed]
total_steps = 300
env = {id = "odd_envs:Odd-v0"}
replay = {capacity = 100, learning_starts = 40}
network = {hidden = [8]}
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a module of environments, a grid, and a finished run of the module's, with a journal."""
    folder = tmp_path_factory.mktemp("odd")
    (folder / "assets").mkdir()
    (folder / "odd_envs.py").write_text(ENVS)
    (folder / "grid.toml").write_text("\ufeff" + GRID, encoding="utf-8")
    flags = ["--env.id", "odd_envs:Odd-v0", *SMALL, "--checkpoint-every", "100", "--replay.journal"]
    run_command("coop-local", *flags, "--run-dir", "run", cwd=folder, environment=odd("rewards"), check=True)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "odd"))


def odd(what: str) -> dict[str, str]:
    return {**os.environ, "ODD": what}


def column(path: Path, name: str) -> list[str]:
    with path.open() as file:
        return [row[name] for row in csv.DictReader(file)]


# The user's own files


def test_a_run_of_processes_leaves_what_it_did_not_write(folder: Path) -> None:
    run = folder / "run"
    checkpoints, journal = run / "checkpoints", next(run.rglob("journal"))
    newest = max(checkpoints.iterdir(), key=lambda path: int(path.name))
    shutil.copytree(newest, checkpoints / "best")
    (checkpoints / "latest").symlink_to(newest.name)
    (run / "videos").mkdir(exist_ok=True)
    mine = [checkpoints / "notes.txt", journal / "notes.log", journal / "0.bak", run / "videos" / "mine.gif"]
    for path in mine:
        path.write_text("mine")
    for line in (
        ["coop-eval", "run", *PLAYED],
        ["coop-export", "run", "--out", "out", *MINE],
        ["coop-reexecute", "run", *MINE],
    ):
        assert run_command(*line, cwd=folder).returncode == 0, line
    more = ["--total-steps", "500", "--checkpoint-every", "20"]
    run_command("coop-local", "--resume", *more, "--run-dir", "run", *MINE, cwd=folder, check=True, timeout=200)
    assert [path.read_text() for path in mine] == ["mine"] * 4
    assert (checkpoints / "best" / "DONE").exists()
    assert (checkpoints / "latest").is_symlink()


def test_a_sweep_and_its_report_leave_what_they_did_not_write(folder: Path) -> None:
    def swept() -> subprocess.CompletedProcess[str]:
        return run_command("coop-sweep", "grid.toml", "--dir", "s", cwd=folder, timeout=200)

    assert swept().returncode == 0
    cell = next(path.parent for path in folder.glob("s/*/summary.json"))
    shutil.copytree(cell, folder / "s" / "copy of mine")
    (folder / "s" / "notes").mkdir()
    (folder / "s" / "notes" / "config.txt").write_text("mine")
    assert swept().returncode == 0
    printed = run_command("coop-report", "s", cwd=folder)
    assert printed.returncode == 0, printed.stderr
    assert (folder / "s" / "copy of mine" / "summary.json").exists()
    assert (folder / "s" / "notes" / "config.txt").read_text() == "mine"


# What environments give, and what is beside a training


class Panic(BaseException):
    """As libraries in Rust raise it: no Exception."""


class Later(Odd):
    """Fails in other ways than `Odd`, or only as the fifth that is made."""

    made = 0

    def __init__(self, wrong: str = "", render_mode: Any = None) -> None:
        super().__init__(wrong, render_mode=render_mode)
        Later.made += 1
        if wrong == "late" and Later.made > 4:  # of the checks, of the training, of an evaluation
            raise Panic("four licences only")

    def step(self, action: Any) -> Any:
        obs, reward, *ends = super().step(action)
        if self.wrong == "panics":
            raise Panic("index out\nof bounds")
        given = {"an int beyond floats": (obs, 10**400), "a dict": ({"a": obs}, 1.0), "nothing": (None, 1.0)}
        return (*given.get(self.wrong, (obs, reward)), *ends)

    def render(self) -> Any:
        return np.full((20, 30, 4), (250, 100, 0, 7), np.uint8) if self.wrong == "opacity" else super().render()


gymnasium.register("test/Later-v1", entry_point=Later)


def later(wrong: str) -> EnvSettings:
    return EnvSettings(id="test/Later-v1", kwargs={"wrong": wrong})


@pytest.mark.parametrize(
    ("wrong", "kind", "words"),
    [
        ("panics", RunError, "at step 1 raised Panic: index out of bounds (test_other_roles.py:"),
        ("an int beyond floats", UsageError, "at step 1 gives reward int; allowed: a single number"),
        ("a dict", UsageError, "at step 1 gives the observation dict; its observation space says float32[3]"),
        ("nothing", UsageError, "at step 1 gives the observation None; its observation space says"),
    ],
)
def test_what_no_environment_should_give(wrong: str, kind: type[CoopError], words: str, tmp_path: Path) -> None:
    env = {"id": "test/Later-v1", "kwargs": {"wrong": wrong}}
    with pytest.raises(kind) as failed:
        coop.evaluate(lambda obs: 0, 1, env)
    assert str(failed.value).startswith("env.id: 'test/Later-v1' " + words)
    with pytest.raises(RunError) as failed:
        coop.train(run_dir=tmp_path / "a", env=env, **SHORT).wait()
    assert str(failed.value).startswith("env.id: 'test/Later-v1' " + words)


def test_whatever_ends_a_run_in_python_is_a_run_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its thread meets no signal, whatever handles them."""

    def interrupted(self: Odd, action: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(Odd, "step", interrupted)
    run = coop.train(run_dir=tmp_path / "a", env={"id": ODD}, **SHORT)
    with pytest.raises(
        RunError, match=r"^env.id: 'test/Odd-v0' at step 1 raised KeyboardInterrupt \(test_other_roles.py:\d+\)$"
    ):
        run.wait()


def test_a_film_whose_environment_can_t_be_made_does_not_end_a_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Later, "made", 0)
    env = {"id": "test/Later-v1", "kwargs": {"wrong": "late"}}
    summary = coop.train(run_dir=tmp_path / "a", env=env, eval_every=50, video_every=30, **SHORT).wait()
    assert summary is not None
    assert summary["exit"] == "complete"
    said = capsys.readouterr().out
    assert "no video after 30 steps: env.id = 'test/Later-v1'" in said
    assert "no evaluation after 50 steps: env.id = 'test/Later-v1'" in said


def test_a_folder_for_films_and_a_picture_that_can_t_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a" / "learning_curve.png").mkdir(parents=True)
    (tmp_path / "a" / "videos").touch()
    summary = coop.train(run_dir=tmp_path / "a", env={"id": ODD}, video_every=30, **SHORT).wait()
    assert summary is not None
    assert summary["exit"] == "complete"
    said = capsys.readouterr().out
    assert "30.gif" in said
    assert "no learning curve" in said


def test_a_backend_that_is_none_and_a_style_that_needs_tex_end_no_picture(folder: Path) -> None:
    (folder / "matplotlibrc").write_text("text.usetex: True\n")
    environment = {**os.environ, "MPLBACKEND": "nonsense"}
    for line in (["coop-lockstep", *SMALL, "--run-dir", "runs/a"], ["coop-report", "runs", "--out", "report"]):
        cold = command(line[0], *line[1:])  # the style is read with the import
        done = subprocess.run(cold, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
    assert (folder / "runs" / "a" / "learning_curve.png").exists()
    assert list((folder / "report").glob("*.png"))


def test_pictures_with_opacity_and_of_one_channel() -> None:
    env = make_filmed_env(later("opacity"), 0)
    env.reset()
    np.testing.assert_array_equal(env.picture()[0, 0], (250, 100, 0))
    env = make_filmed_env(EnvSettings(id=ODD, kwargs={"dtype": "uint8", "shape": [20, 30, 1]}), 0)
    inner(env).right[:] = 90
    env.reset()
    assert env.picture().shape == (20, 30, 3)
    env.step(np.zeros(1, np.int32))
    np.testing.assert_array_equal(np.ptp(env.picture(), axis=2), 0)


# Output, and processes that end by themselves


def test_a_run_of_processes_in_a_folder_whose_name_is_not_utf_8(tmp_path: Path) -> None:
    done = run_command("coop-local", *SMALL, "--run-dir", "b\udcff", cwd=tmp_path, timeout=200)
    assert done.returncode == 0, done.stderr
    assert "files in" in done.stdout
    assert (tmp_path / "b\udcff" / "summary.json").exists()


@pytest.mark.parametrize("line", [["coop-lockstep", *SMALL, "--run-dir", "a"], ["coop-eval", "run", *PLAYED]])
def test_an_environment_that_takes_the_streams_away(line: list[str], folder: Path) -> None:
    flags = ["--env.id", "odd_envs:Odd-v0"] if line[0] == "coop-lockstep" else []
    done = run_command(*line, *flags, cwd=folder, environment=odd("streams"))
    assert done.returncode == 0, done.stderr
    last = done.stdout.splitlines()[-1]
    assert last.startswith("complete: 300 steps" if flags else "run ")


@pytest.mark.parametrize("line", [["coop-sweep", "grid.toml", "--dir", "s"], ["coop-eval", "run", "run", *PLAYED]])
def test_a_reader_that_goes_after_a_line(line: list[str], folder: Path) -> None:
    done = run_for_a_line(*line, cwd=folder, timeout=200)
    assert "Traceback" not in done.stderr
    assert "error" not in done.stderr.replace("error: interrupted with", ""), "a sweep says how far it has come"
    assert done.returncode in (0, 141)
    assert done.stdout.endswith("\n")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (["coop-eval", "run", *PLAYED], "coop-eval: error: env.id: 'odd_envs:Odd-v0' at step 1 raised SystemExit: no"),
        (["coop-sweep", "grid.toml", "--dir", "s"], "coop-sweep: error: 2 of 2 cells failed"),
    ],
)
def test_an_environment_that_exits_is_named(line: list[str], words: str, folder: Path) -> None:
    done = run_command(*line, cwd=folder, environment=odd("exit"), timeout=200)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(words)
    assert "SystemExit: no licence" in done.stderr + done.stdout


@pytest.mark.parametrize(
    "line",
    [["coop-local", *SMALL, "--env.id", "odd_envs:Odd-v0"], ["coop-lockstep", *SMALL, "--env.id", "odd_envs:Odd-v0"]],
)
def test_an_environment_that_interrupts_fails(line: list[str], folder: Path) -> None:
    done = run_command(*line, "--run-dir", "anew", cwd=folder, environment=odd("closed window"), timeout=200)
    assert done.returncode == 1
    assert "at step 1 raised KeyboardInterrupt: window closed" in done.stderr


# Limits of the job


def test_what_a_job_allows_holds_for_sweeps_and_in_python(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = {**os.environ, "SLURM_MEM_PER_NODE": "1"}
    (folder / "large.toml").write_text(GRID.replace("= 100,", "= 100000,").replace("= 300", "= 1000000"))
    done = run_command("coop-sweep", "large.toml", "--dir", "s", cwd=folder, environment=environment, timeout=200)
    assert done.returncode == 1
    assert done.stdout.count("Slurm's job has (SLURM_MEM_PER_NODE)") >= 2
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "1")
    with pytest.raises(UsageError, match=r"replay\.capacity = 100,000: .* Slurm's job has"):
        coop.train(run_dir=folder / "b", total_steps=10**6, replay={"capacity": 100_000})


# Episodes without end


def test_films_and_evaluations_of_a_training_are_bounded(
    trained: SavedRun, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(output, "_warned", set())
    for module, name, most in (
        (film_module, "MOST", 95),
        (film_module, "LONGEST", 60),
        (gymnasium_env, "LONGEST_EPISODE", 300),
    ):
        monkeypatch.setattr(module, name, most)
    endless = EnvSettings(id=ODD, kwargs={"wrong": "endless"})
    film = Film(lambda obs: 0, endless, 0)
    assert sum(1 for _ in film) == film.steps == 95
    config = replace(trained.config, env=endless, eval_episodes=1)
    env = make_vector_env(endless, 1, 0)
    row = Evaluator(config, lambda: False).evaluate(Agent(config, env.spec).networks[0], 1, 0, 7)
    assert row is not None
    assert row.return_mean == 300
    assert capsys.readouterr().err.count("env.max_episode_steps") == 1
    assert short_gif(Film(lambda obs: 0, endless, 0)).startswith(b"GIF89a")


# The working directory, and paths


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> SavedRun:
    path = tmp_path_factory.mktemp("runs") / "odd"
    coop.train(run_dir=path, env={"id": ODD}, **SHORT).wait()
    return coop.load(path)


def test_evaluations_films_exports_and_sweeps_stay_where_they_were_begun(folder: Path) -> None:
    for line in (
        ["coop-eval", "run", *PLAYED, "--video", "film.gif"],
        ["coop-export", "run", "--out", "exported", *MINE],
        ["coop-sweep", "grid.toml", "--dir", "s"],
    ):
        done = run_command(*line, cwd=folder, environment=odd("directory"), timeout=200)
        assert done.returncode == 0, done.stderr
    assert (folder / "film.gif").stat().st_size
    assert (folder / "exported" / "card.json").exists()
    assert len(list(folder.glob("s/*/summary.json"))) == 2
    assert not list((folder / "assets").iterdir())


@pytest.mark.parametrize("path", ["a" * 300, "a\0b", "", "~no-such-account/a", "/".join(["b" * 200] * 25)])
def test_paths_that_can_not_be_are_refused_in_python(path: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    calls: list[Callable[[], object]] = [
        lambda: coop.train(run_dir=path, **SHORT),
        lambda: coop.train(config=path, **SHORT),
        lambda: coop.load(path),
        lambda: coop.sweep({"methods": ["dqn"]}, path),
    ]
    for call in calls:
        with pytest.raises(UsageError) as refused:
            call()
        assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


# Records, policies and threads


def test_returns_cross_the_wire_exactly(made: Path) -> None:
    returns = column(made / "run" / "episodes.csv", "return")
    lengths = column(made / "run" / "episodes.csv", "length")
    assert [float(text) for text in returns] == [
        reduce(add, [123456.789] * int(length)) for length in lengths
    ]  # sum() compensates
    summary = json.loads((made / "run" / "summary.json").read_text())
    assert summary["return_mean_100"] == pytest.approx(sum(map(float, returns[-100:])) / len(returns[-100:]), rel=1e-12)


def test_policies_refuse_what_overflows_and_evaluations_what_is_no_action(trained: SavedRun) -> None:
    with pytest.raises(UsageError, match="not finite"):
        trained.policy().q_values(np.full(3, 1e300))
    for given, words in ((None, "gives None"), (5, "gives 5"), (0.5, r"gives 0\.5"), ([0, 1], r"gives int64\[2\]")):
        with pytest.raises(UsageError, match=words):
            coop.evaluate(lambda obs, given=given: given, 1, ODD, epsilon=0.5)


@pytest.mark.parametrize(
    "line",
    [["coop-eval", "run", *PLAYED], ["coop-export", "run", "--out", "out", *MINE], ["coop-local", "--run-dir", "a"]],
)
def test_threads_that_stay_keep_no_command(line: list[str], folder: Path) -> None:
    flags = ["--env.id", "odd_envs:Odd-v0", *SMALL] if line[0] == "coop-local" else []
    done = run_command(*line, *flags, cwd=folder, environment=odd("thread"), timeout=150)
    assert done.returncode == 0, done.stderr
    assert "the thread 'viewer' has not ended" in done.stderr


@pytest.mark.skipif(os.geteuid() != 0, reason="a network without loopback needs root")
@pytest.mark.parametrize("role", ["learner", "replay", "actor", "watch"])
def test_each_role_says_at_once_that_there_is_no_loopback(role: str, tmp_path: Path) -> None:
    where = ["--listen" if role == "learner" else "--connect", "tcp/127.0.0.1:7447"]
    command = [str(Path(sys.executable).parent / f"coop-{role}"), "--run", "a", *where]
    done = subprocess.run(
        ["unshare", "-n", *command], check=False, cwd=tmp_path, capture_output=True, text=True, timeout=100
    )
    assert done.returncode in (1, 2)
    assert "loopback interface can't be used" in done.stderr.splitlines()[-1]
