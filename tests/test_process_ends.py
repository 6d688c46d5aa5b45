"""Processes that end by themselves: what will come again ends the run at once, with the reason and its status."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from commands import run_command

import coop
from coop.common.process.lifecycle import run_main
from coop.common.process.processes import ChildProcess
from coop.deploy.supervisor import HEALTHY, RESTARTS, RestartPolicy

pytestmark = pytest.mark.timeout(300)  # several processes a test, also on a busy machine

SMALL = ["--total-steps", "300", "--replay.capacity", "100", "--replay.learning-starts", "40", "--network.hidden", "8"]
ENVS = """
import os, sys
import gymnasium
import numpy as np
from gymnasium.envs.classic_control import CartPoleEnv

class Ending(CartPoleEnv):
    steps = 0
    def step(self, action):
        self.steps += 1
        if self.steps == 5:
            self.end()
        return super().step(action)

class Raising(Ending):
    def end(self): raise RuntimeError("the simulator has lost\\nits connection")
class Exiting(Ending):
    def end(self): sys.exit()
class Vanishing(Ending):
    def end(self): os._exit(0)
class Crashing(Ending):
    def end(self): os.abort()
class Refused(CartPoleEnv):
    def reset(self, **keywords): return np.zeros(7, np.float32), {}
class NotEvaluated(Ending):
    def end(self):
        if "eval" in sys.argv[0]: os.abort()

for kind in (Raising, Exiting, Vanishing, Crashing, Refused, NotEvaluated):
    gymnasium.register(kind.__name__ + "-v0", entry_point=kind)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "ending_envs.py").write_text(ENVS)
    (tmp_path / "exiting_module.py").write_text("import sys\nsys.exit(0)\n")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "status", "starts", "reason"),
    [
        ("Raising", 1, 2, "the simulator has lost"),
        ("Exiting", 1, 2, "actor process 1 ended (exit status 1): coop-actor: error: "),
        ("Vanishing", 1, 2, "ended by itself before the run did (exit status 0)"),
        ("Crashing", 1, 2, "was killed by SIGABRT"),
        ("Refused", 2, 1, "Refused-v0"),
    ],
)
def test_an_actor_that_would_end_again(name: str, status: int, starts: int, reason: str, folder: Path) -> None:
    flags = ["--env.id", f"ending_envs:{name}-v0", *SMALL, "--run-dir", "run"]
    done = run_command("coop-local", *flags, cwd=folder, timeout=200)
    assert done.returncode == status, done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("coop-local: error: actor process 1 ")
    assert reason in last
    assert done.stdout.count("starting it again") == starts - 1


def test_a_run_goes_on_without_its_evaluator(folder: Path) -> None:
    flags = ["--env.id", "ending_envs:NotEvaluated-v0", *SMALL, "--eval-every", "50", "--run-dir", "run"]
    flags[flags.index("300")] = "3000"
    done = run_command("coop-local", *flags, cwd=folder, timeout=200)
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "run" / "summary.json").read_text())["exit"] == "complete"
    assert done.stdout.count("the run goes on without it") == 1


STARTS = """
import os
from coop.deploy.local import main

try:
    main()
finally:
    try:
        print("left:", os.waitpid(-1, os.WNOHANG))
    except ChildProcessError:
        print("none is left")
"""


def test_a_role_that_can_not_start_ends_those_before_it(tmp_path: Path) -> None:
    (tmp_path / "a" / "logs" / "actor-1.log").mkdir(parents=True)
    line = [sys.executable, "-c", STARTS, *SMALL, "--run-dir", "a"]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=200)
    assert done.stdout.splitlines()[-1] == "none is left"
    assert (done.returncode, done.stderr) == (1, f"coop-local: error: {tmp_path}/a/logs/actor-1.log: Is a directory\n")
    assert (tmp_path / "a" / "logs" / "learner.log").exists(), "it had been started"


def test_sys_exit_in_a_lockstep_run_is_a_failure(folder: Path) -> None:
    done = run_command("coop-lockstep", "--env.id", "ending_envs:Exiting-v0", *SMALL, "--run-dir", "run", cwd=folder)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("coop-lockstep: error: ")
    assert json.loads((folder / "run" / "summary.json").read_text())["exit"].startswith("failed: ")


def test_sys_exit_in_a_module_is_named(folder: Path) -> None:
    done = run_command("coop-lockstep", "--env.id", "exiting_module:Room-v0", *SMALL, cwd=folder)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith("cannot import 'exiting_module': SystemExit: 0")


def test_sys_exit_does_not_end_the_program_that_trains(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(folder)
    settings = {"replay": {"capacity": 100, "learning_starts": 40}, "network": {"hidden": [8]}}
    run = coop.train(env={"id": "ending_envs:Exiting-v0"}, total_steps=300, run_dir=folder / "run", **settings)
    with pytest.raises(coop.RunError):
        run.wait()


@pytest.mark.parametrize(
    ("error", "status", "lines"),
    [
        (RuntimeError("it has\ntwo lines"), 1, ["coop-x: error: RuntimeError: it has"]),
        (SystemExit(0), 1, ["coop-x: error: sys.exit(0) was called in fail, line "]),
        (PermissionError(13, "Permission denied", "/a/b"), 1, ["coop-x: error: /a/b: Permission denied"]),
        (coop.UsageError("no such thing"), 2, ["coop-x: error: no such thing"]),
    ],
)
def test_the_last_line_says_what_failed(
    error: BaseException, status: int, lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise error

    with pytest.raises(SystemExit) as end:
        run_main("coop-x", fail)
    assert end.value.code == status
    printed = capsys.readouterr().err.splitlines()
    assert printed[-1].startswith(lines[-1])
    assert ("Traceback" in printed[0]) == isinstance(error, RuntimeError)


def test_the_same_words_twice_at_once_are_certain() -> None:
    def ends(*words: str, every: float = 3.0) -> list[bool]:
        policy = RestartPolicy()
        return [bool(policy.ended(100 + every * number, each)) for number, each in enumerate(words)]

    assert ends("1 a", "1 a") == [False, True]
    assert ends("1 a", "1 b", "1 a") == [False, False, False]
    assert ends("1 a", "1 a", every=HEALTHY) == [False, False]
    assert ends(*[""] * RESTARTS) == [False] * RESTARTS, "killed by others"


def test_a_command_s_own_words_are_those_of_its_last_start(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text("coop-x: error: an earlier one\n")
    child = ChildProcess("x", ["bash", "-c", "echo 'coop-x: error: '$RANDOM; echo cleaning up; exit 3"], log)
    child.start()
    child.end(20)
    assert child.why().startswith("x ended (exit status 3): coop-x: error: ")
    assert "earlier" not in child.why()
    assert child.last_line() == "cleaning up"
    assert child.has_said("error")
    assert not child.has_said("an earlier one")
    assert child.own_words().startswith("3 coop-x: error: ")


def test_defaults_of_torch_that_users_code_has_set_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    def main() -> None:
        torch.set_default_device("meta")
        torch.nn.Linear(2, 2).to("cpu")

    try:
        with pytest.raises(SystemExit) as end:
            run_main("coop-lockstep", main)
    finally:
        torch.set_default_device(None)
    said = capsys.readouterr().err
    assert end.value.code == 1
    assert said.count("\n") == 1
    assert "torch's default device to meta" in said
