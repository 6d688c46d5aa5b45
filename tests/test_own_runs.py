"""Runs of a module of environments in a folder outside the project, through the console commands."""

import json
import os
import re
import signal
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import my_envs
import pytest
from commands import Command, run_command, wait_for

from coop.common.errors import RunError
from coop.common.process.processes import free_endpoint
from coop.common.settings.environment import EnvSettings
from coop.lockstep.lockstep import Lockstep
from coop.records.learner_checkpoints import newest_checkpoint
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config

pytestmark = pytest.mark.timeout(300)  # whole runs, also on a busy machine
OWN = Path(__file__).with_name("data") / "own" / "my_envs.py"
SHORT = [
    *("--method", "dqn", "--total-steps", "200", "--replay.capacity", "100", "--replay.learning-starts", "100"),
    *("--checkpoint-every", "50", "--actor.epsilon-final", "0.9"),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the module, and nothing else."""
    place = tmp_path / "elsewhere"
    place.mkdir()
    (place / "my_envs.py").write_text(OWN.read_text())
    return place


def run(folder: Path, name: str, *flags: str) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return run_command(name, *flags, cwd=folder, environment=environment, timeout=280)


@pytest.mark.parametrize(("env_id", "network"), [("Room", "nips2013"), ("Planes", "minatar")])
@pytest.mark.parametrize("command", [["coop-lockstep"], ["coop-local", "--actors", "2"]])
def test_a_module_elsewhere_is_trained(folder: Path, env_id: str, network: str, command: list[str]) -> None:
    flags = ["--env.id", f"my_envs:{env_id}-v0", "--env.kwargs", "{side = 5}", "--network.kind", network]
    done = run(folder, *command, *flags, *SHORT, "--run-dir", "run")
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((folder / "run" / "summary.json").read_text())
    assert (summary["exit"], summary["transitions_lost"]) == ("complete", 0)
    assert "[env.kwargs]\nside = 5\n" in (folder / "run" / "config.toml").read_text()
    if command == ["coop-lockstep"]:
        played = run(folder, "coop-eval", "run", "--episodes", "2")
        assert re.search(r"^run +100 +1 acts +0 +2 ", played.stdout, re.MULTILINE), played.stderr


SLOW = """
import time
from pathlib import Path
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

class Slow(CartPoleEnv):
    def step(self, action):
        time.sleep(0.02 * Path("slow").exists())
        return super().step(action)

gymnasium.register("Slow-v0", entry_point=Slow, max_episode_steps=200)
"""


def test_playing_the_actions_again_shows_progress_and_can_be_interrupted(tmp_path: Path) -> None:
    (tmp_path / "slow_envs.py").write_text(SLOW)
    flags = ["--env.id", "slow_envs:Slow-v0", *SHORT, "--total-steps", "600", "--run-dir", "run"]
    done = run(tmp_path, "coop-lockstep", *flags)
    assert done.returncode == 0, done.stdout + done.stderr
    paths = [path for path in (tmp_path / "run").rglob("*") if path.is_file() and path.suffix != ".lock"]
    files = [path.read_bytes() for path in paths]
    (tmp_path / "slow").touch()
    command = Command("coop-lockstep", *flags, "--total-steps", "1000", "--resume", cwd=tmp_path)  # takes 12 s
    wait_for("progress", lambda: command.output()[0])
    command.send_signal(signal.SIGINT)
    done = command.end(60)
    assert done.returncode == 130, done.stderr
    shown, said = done.stdout.splitlines()
    assert re.fullmatch(r"plays the run's actions again: \d+/600", shown)
    assert said == "interrupted before the run went on; its files are as they were"
    assert files == [path.read_bytes() for path in paths]


class Changed(my_envs.Room):
    """The same room with one thing changed, by name."""

    def __init__(self, what: str, **options: Any) -> None:
        super().__init__(**options)
        self.what = what

    def reset(self, **options: Any) -> Any:
        observation, info = super().reset(**options)
        return (observation ^ (self.what == "first pixel" and self.count == 1)), info

    def step(self, action: int) -> Any:
        observation, reward, over, cut, info = super().step(action)
        late = self.count > 90
        observation ^= self.what == "pixel" and late
        return (
            observation,
            reward + 0.5 * (self.what == "reward" and late),
            over,
            cut or (self.what == "end" and late),
            info,
        )


gymnasium.register("test/Changed-v0", entry_point=Changed)


@pytest.mark.parametrize("what", ["nothing", "first pixel", "pixel", "reward", "end"])
@pytest.mark.parametrize("stack", [1, 2])
def test_lockstep_goes_on_only_where_the_environment_repeats(tmp_path: Path, what: str, stack: int) -> None:
    config = base_config(["--method", "dqn"])
    kwargs = {"kind": "planes", "what": "nothing"}
    config = replace(config, env=EnvSettings(id="test/Changed-v0", stack=stack, kwargs=kwargs))
    first = Lockstep(config)
    with RunDirectory(tmp_path, config) as directory:
        for _ in range(100):
            list(first.play())
        first.save(directory)
    again = Lockstep(replace(config, env=replace(config.env, kwargs={**kwargs, "what": what})))
    checkpoint = newest_checkpoint(tmp_path)
    assert checkpoint is not None
    if what == "nothing":
        again.restore(checkpoint)
        return
    with pytest.raises(RunError, match="test/Changed-v0 showed something else when the run's 100 actions were played"):
        again.restore(checkpoint)


def test_an_actor_imports_only_what_its_own_user_allows(folder: Path, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    joining = ["--connect", endpoint, "--join-timeout", "60"]
    roles = [
        ["coop-learner", "--env.id", "my_envs:Planes-v0", "--network.kind", "minatar", "--listen", endpoint],
        ["coop-replay", *joining, "--run-dir", str(tmp_path / "replay")],
    ]
    processes = [Command(name, *flags, cwd=folder) for name, *flags in roles]
    try:
        refused = run(folder, "coop-actor", *joining, "--allow-import", "other", "my_envs_too")
        assert refused.returncode == 1
        assert refused.stderr.splitlines()[-1].endswith(
            "env.id = 'my_envs:Planes-v0': this process may not import 'my_envs'; start it with --allow-import my_envs"
        )
    finally:
        for process in processes:
            process.send_signal(signal.SIGTERM)
        for process in processes:
            process.end(60)
