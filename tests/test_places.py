"""Working directories that users' code leaves or somebody deletes, and paths that can't be."""

import subprocess
import sysconfig
from pathlib import Path

import pytest
from commands import run_command

pytestmark = pytest.mark.timeout(300)

SCRIPTS = Path(sysconfig.get_path("scripts"))
SMALL = ["--total-steps", "300", "--replay.capacity", "100", "--replay.learning-starts", "40", "--network.hidden", "8"]
ENVS = """
import os
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

ASSETS = os.path.abspath("assets")
class Early(CartPoleEnv):
    def __init__(self):
        super().__init__()
        os.chdir(ASSETS)
class Late(CartPoleEnv):
    def step(self, action):
        os.chdir(ASSETS)
        return super().step(action)
for kind in (Early, Late):
    gymnasium.register(kind.__name__ + "-v0", entry_point=kind)
"""


@pytest.mark.parametrize(("command", "name"), [("coop-lockstep", "Late"), ("coop-local", "Early")])
def test_an_environment_that_changes_directory(command: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "moving_envs.py").write_text(ENVS)
    flags = ["--env.id", f"moving_envs:{name}-v0", *SMALL, "--checkpoint-every", "50"]
    done = run_command(command, *flags, "--run-dir", "runs/a", cwd=tmp_path, timeout=200)
    assert done.returncode == 0, done.stderr
    assert "runs/a" in done.stdout.splitlines()[-1]
    printed = run_command("coop-eval", "runs/a", "--episodes", "1", "--networks", "1", cwd=tmp_path)
    assert printed.stdout.splitlines()[-1].startswith("runs/a "), printed.stderr
    assert (tmp_path / "runs" / "a" / "summary.json").exists()
    assert not list((tmp_path / "assets").iterdir())


@pytest.mark.parametrize(
    "line",
    [
        "coop-lockstep", "coop-local", "coop-learner --run-dir a", "coop-eval a", "coop-export a --out b",
        "coop-report a", "coop-reexecute a", "coop-sweep small-buffers",
    ],
)  # fmt: skip
def test_a_working_directory_that_has_been_deleted(line: str, tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    done = subprocess.run(
        ["bash", "-c", f"rmdir ../gone && exec {SCRIPTS}/{line}"], cwd=tmp_path / "gone",
        capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert done.returncode == 2
    name = line.split(maxsplit=1)[0]
    assert done.stderr == f"{name}: error: the working directory has been deleted; give absolute paths\n"


def test_absolute_paths_in_a_working_directory_that_has_been_deleted(tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    run, short = tmp_path / "a", "--replay.capacity 100 --replay.learning-starts 40 --total-steps 60"
    lines = [f"coop-lockstep {short} --run-dir {run}", f"coop-eval {run} --episodes 1 --networks 1"]
    for line in lines:
        (tmp_path / "gone").mkdir(exist_ok=True)
        done = subprocess.run(
            ["bash", "-c", f"rmdir ../gone && exec {SCRIPTS}/{line}"], cwd=tmp_path / "gone",
            capture_output=True, text=True, check=False, timeout=100,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("path", ["a" * 300, "file/below", "/".join(["b" * 200] * 25)])
@pytest.mark.parametrize(
    "line", ["coop-lockstep --run-dir {}", "coop-local --resume --run-dir {}", "coop-eval {}", "coop-report {}"]
)
def test_a_path_that_can_not_be_is_one_line(line: str, path: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = run_command(*line.format(path).split(), cwd=tmp_path)
    assert done.returncode in (1, 2)
    assert done.stderr.startswith(f"{line.split(maxsplit=1)[0]}: error: ")
    assert done.stderr.count("\n") == 1
