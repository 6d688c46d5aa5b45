"""Runs of a module of environments in a folder outside the project, through the console commands."""

import json
import os
import subprocess
import sysconfig
from pathlib import Path

import pytest

from common.process.processes import free_endpoint

SCRIPTS = Path(sysconfig.get_path("scripts"))
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
    return subprocess.run(
        [SCRIPTS / name, *flags], cwd=folder, env=environment, capture_output=True, text=True, timeout=110, check=False
    )


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
        assert "return of 2 greedy episodes" in played.stdout, played.stderr


def test_lockstep_goes_on_only_where_the_environment_repeats(folder: Path) -> None:
    module = folder / "my_envs.py"
    flags = ["--env.id", "my_envs:Planes-v0", *SHORT]
    assert run(folder, "coop-lockstep", *flags, "--run-dir", "run").returncode == 0
    longer = ["--resume", "--run-dir", "run", "--total-steps"]
    again = run(folder, "coop-lockstep", *longer, "220")
    assert again.returncode == 0, again.stderr
    module.write_text(module.read_text().replace("float(arrived), arrived", "2 * float(arrived), arrived"))
    before = (folder / "run" / "episodes.csv").read_bytes()
    refused = run(folder, "coop-lockstep", *longer, "240")
    assert refused.returncode == 1
    assert "my_envs:Planes-v0 showed something else when the run's 220 actions were played again" in refused.stderr
    assert refused.stderr.count("\n") == 1
    assert (folder / "run" / "episodes.csv").read_bytes() == before


def test_an_actor_imports_only_what_its_own_user_allows(folder: Path, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    joining = ["--connect", endpoint, "--join-timeout", "60"]
    roles = [
        ["coop-learner", "--env.id", "my_envs:Planes-v0", "--network.kind", "minatar", "--listen", endpoint],
        ["coop-replay", *joining, "--run-dir", str(tmp_path / "replay")],
    ]
    processes = [subprocess.Popen([SCRIPTS / name, *flags], cwd=folder) for name, *flags in roles]
    try:
        refused = run(folder, "coop-actor", *joining, "--allow-import", "other", "my_envs_too")
        assert refused.returncode == 1
        assert refused.stderr.splitlines()[-1].endswith(
            "env.id = 'my_envs:Planes-v0': this process may not import 'my_envs'; start it with --allow-import my_envs"
        )
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(60)
