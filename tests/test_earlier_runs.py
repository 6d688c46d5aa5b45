"""A run directory of version 0.1.0 before its settings were renamed is resumed, evaluated and reported.

`data/earlier-lockstep-run.tar.gz` was made at commit 3dc97f6 by `coop-lockstep --method g-coop --total-steps 200
--replay.start 40 --replay.capacity 60 --network.hidden 4 --learner.denominator 1e-6 --learner.swap-every 20`.
"""

import json
import tarfile
from pathlib import Path

import pytest
from commands import run_command

from experiments.evaluation import evaluate_checkpoint
from experiments.report.study import load_study

DATA = Path(__file__).with_name("data") / "earlier-lockstep-run.tar.gz"


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    with tarfile.open(DATA) as archive:
        archive.extractall(tmp_path / "study" / "run", filter="data")
    return tmp_path / "study" / "run"


def test_it_is_evaluated_and_reported(earlier: Path) -> None:
    assert next(evaluate_checkpoint(earlier, 1, 0)).epoch == 160
    (run,) = load_study(earlier.parent).runs
    assert run.config.replay.learning_starts == 40
    assert run.config.learner.beta2 == 0.999
    assert run.config.learner.eps == 1e-6


def test_it_goes_on_and_one_line_says_the_new_names(earlier: Path) -> None:
    result = run_command("coop-lockstep", "--resume", "--run-dir", earlier, "--total-steps", "300", check=True)
    (line,) = result.stderr.splitlines()
    assert line.startswith("note: replay.start is now replay.learning_starts, ")
    assert "learner.squared_decay is now learner.beta2, learner.denominator is now learner.eps" in line
    summary = json.loads((earlier / "summary.json").read_text())
    assert (summary["env_steps"], summary["updates"], summary["exit"]) == (300, 260, "complete")
    numbers = [int(row.split(",")[0]) for row in (earlier / "episodes.csv").read_text().splitlines()[1:]]
    assert numbers == list(range(len(numbers)))
