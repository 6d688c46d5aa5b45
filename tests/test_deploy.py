"""The container files agree with the commands: every service's command line is one that its role accepts."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from actors.cli import ActorOptions
from common.process import cli
from common.settings.options import RoleOptions, RunOptions, parse_run
from learner.cli import LearnerOptions
from replay.cli import ReplayOptions

DEPLOY = Path(__file__).parents[1] / "deploy"


def _services() -> dict[str, Any]:
    text = (DEPLOY / "compose.yaml").read_text()
    with_defaults = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)
    services: dict[str, Any] = yaml.safe_load(with_defaults)["services"]
    return services


def _parse(service: str, monkeypatch: pytest.MonkeyPatch) -> RunOptions | RoleOptions:
    program, *flags = _services()[service]["command"]
    monkeypatch.setattr("sys.argv", [program, *flags])
    assert program == f"coop-{service}"
    match service:
        case "learner":
            return parse_run(LearnerOptions, program, "")
        case "replay":
            return cli.parse(ReplayOptions, program, "")
        case _:
            return cli.parse(ActorOptions, program, "")


@pytest.mark.parametrize("service", ["learner", "replay", "actor"])
def test_each_command_line_is_accepted(service: str, monkeypatch: pytest.MonkeyPatch) -> None:
    options = _parse(service, monkeypatch)
    assert options.run == "compose"
    if isinstance(options, RoleOptions):
        assert options.connect == ("tcp/learner:7447",)


def test_learner_and_replay_write_to_the_same_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, replay = _parse("learner", monkeypatch), _parse("replay", monkeypatch)
    assert isinstance(learner, LearnerOptions)
    assert isinstance(replay, ReplayOptions)
    assert learner.run_dir == replay.run_dir
    assert learner.run_config().total_steps == 50_000


def test_the_image_ends_without_root() -> None:
    steps = (DEPLOY / "Dockerfile").read_text().splitlines()
    users = [number for number, line in enumerate(steps) if line.startswith("USER ")]
    assert steps[users[-1]] != "USER root"
    assert not [line for line in steps[users[-1] :] if line.startswith("RUN ")]
