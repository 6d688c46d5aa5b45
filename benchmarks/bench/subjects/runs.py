"""Whole runs of CartPole with equal work, a turn each: runs.py lockstep|distributed STEPS."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from learn import run
from turns import attend


def main(who: str, steps: str) -> None:
    def turn(_: float) -> dict[str, float]:
        with tempfile.TemporaryDirectory() as folder:
            summary = run(who, "cartpole", 0, Path(folder), "--total-steps", steps)
        return {"steps/s": summary["env_steps"] / summary["wall_seconds"]}

    attend(turn)


main(*sys.argv[1:])
