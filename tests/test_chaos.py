"""A short run under fire (`make chaos` is the long one), and what its journal proves."""

import re
from pathlib import Path

import pytest
from commands import run_command

CHAOS = Path(__file__).parents[1] / "benchmarks" / "chaos.py"


@pytest.mark.timeout(240)  # a busy machine starts eight processes slowly
def test_a_kill_of_each_role(tmp_path: Path) -> None:
    flags = ["--kills=3", "--total-steps=2000", "--checkpoint-every=200", "--longest-pause=1", "--give-up=200"]
    done = run_command(CHAOS, f"--run-dir={tmp_path / 'run'}", *flags, timeout=230)
    assert (done.returncode, done.stderr) == (0, "")
    report = dict(re.split(r" {2,}", line, maxsplit=1) for line in done.stdout.splitlines())
    assert report["kills"].startswith("3 (")
    assert report["lost"] == "0"
    assert re.fullmatch(r"0 of [12],\d{3}", report["duplicated"])
    assert report["restarts"] == "3"
    assert "bit for bit" in report["re-executed"]
