"""Runs that begin with the networks of another run."""

import shutil
from pathlib import Path

import pytest
import torch
from commands import run_command
from torch import Tensor

from coop.lockstep.reexecute import reexecute
from coop.records.learner_checkpoints import newest_checkpoint

FLAGS = ("--learner.learning-rate", "1e-30")  # keeps the networks as they are
SHORT = ("--total-steps", "300", "--replay.learning-starts", "100")


def networks(path: Path) -> list[Tensor]:
    checkpoint = newest_checkpoint(path)
    assert checkpoint is not None
    found: list[Tensor] = checkpoint.state["agent"]["networks"]
    return found


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "run"
    run_command("coop-lockstep", *SHORT, "--seed", "8", "--run-dir", path, check=True)
    return path


def begins_with(path: Path, source: Path) -> bool:
    return all(map(torch.equal, networks(path), networks(source)))


def test_in_lockstep_and_resumed_without_the_other_run(source: Path, tmp_path: Path) -> None:
    path, copied = tmp_path / "run", tmp_path / "source"
    shutil.copytree(source, copied)
    named = ("--learner.initial-networks", copied)
    run_command("coop-lockstep", *FLAGS, *SHORT, *named, "--run-dir", path, check=True)
    assert begins_with(path, source)
    shutil.rmtree(copied)
    done = run_command("coop-lockstep", "--resume", "--total-steps", "400", "--run-dir", path, check=True)
    assert "resuming from checkpoint 200" in done.stdout
    assert begins_with(path, source)


def test_in_processes_executed_again_and_started_anew(source: Path, tmp_path: Path) -> None:
    path = tmp_path / "run"
    flags = (*FLAGS, *SHORT, "--learner.initial-networks", source, "--replay.journal", "--replay.journal-keep")
    run_command("coop-local", "--actors", "1", *flags, "--run-dir", path, check=True)
    assert begins_with(path, source)
    assert reexecute(path).began == 0
    shutil.rmtree(path / "journal")
    for lost in path.glob("checkpoints/*/replay"):
        shutil.rmtree(lost)
    again = ("--actors", "1", "--resume", "--restart", "--run-dir", path)
    assert "starting over" in run_command("coop-local", *again, check=True).stdout
    assert begins_with(path, source)


@pytest.mark.parametrize(
    ("flags", "problem"),
    [
        ((), "its networks have 33,922 parameters; this run's have 23"),
        (("--learner.initial-networks", "nowhere"), "'nowhere': holds no complete checkpoint of a run"),
        (("--method", "stream-q"), "not for method 'stream-q'"),
    ],
)
def test_refused(flags: tuple[str, ...], problem: str, source: Path, tmp_path: Path) -> None:
    begun = ("--learner.initial-networks", source, "--network.hidden", "3", "--run-dir", tmp_path / "run", *flags)
    for command in ("coop-lockstep", "coop-local") if not flags else ("coop-lockstep",):
        done = run_command(command, *begun)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
        assert problem in done.stderr
