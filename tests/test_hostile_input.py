"""Hostile messages against live processes (`make fuzz` in short), and a checkpoint that would execute something."""

import os
from pathlib import Path

import pytest
import torch
from commands import run_command

from coop.common.errors import RunError
from coop.records.learner_checkpoints import load_learner

FUZZ = Path(__file__).parents[1] / "benchmarks" / "fuzz.py"


@pytest.mark.timeout(300)  # 20 s on a free machine: every role of a run starts
def test_broken_messages_change_nothing_and_valid_ones_stop_nothing() -> None:
    done = run_command(FUZZ, "--messages=3000", "--seed=7", timeout=280)
    assert (done.returncode, done.stderr) == (0, "")
    assert "at rest; changed: nothing" in done.stdout
    assert "lost 0, duplicated 0" in done.stdout
    assert "valid messages: the run went on" in done.stdout


class _Trap:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("sprung",)


def test_a_checkpoint_executes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"agent": _Trap()}, tmp_path / "learner.pt")
    with pytest.raises(RunError, match=r"names (posix|nt)\.mkdir"):
        load_learner(tmp_path)
    assert not (tmp_path / "sprung").exists()
