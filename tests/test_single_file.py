"""The paper on one page is the product's algorithm: its episodes equal a lockstep run's to the byte."""

import io
import runpy
from pathlib import Path

import pytest
from commands import run_command

EXAMPLE = Path(__file__).parents[1] / "examples" / "coop_single_file.py"


@pytest.mark.timeout(240)
@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop"])
def test_the_single_file_plays_the_episodes_of_lockstep(method: str, tmp_path: Path) -> None:
    steps = 5000
    flags = ["--preset", "cartpole-paper", "--learner.optimizer", "rmsprop", "--method", method, "--seed", "1"]
    ended = run_command(
        "coop-lockstep", *flags, "--total-steps", str(steps), "--run-dir", tmp_path / "run", timeout=120
    )
    assert ended.returncode == 0, ended.stderr
    written = io.StringIO()
    runpy.run_path(str(EXAMPLE))["train"](method, 1, steps, written)
    assert written.getvalue().encode() == (tmp_path / "run" / "episodes.csv").read_bytes()


def test_the_single_file_is_a_page() -> None:
    assert len(EXAMPLE.read_text(encoding="utf-8").splitlines()) <= 250
