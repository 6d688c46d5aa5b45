"""Whole runs to a mean return over 100 episodes, each round's number its seed: learn.py WHO TASK [METHOD].

A turn is a new process, from its start to its end. A run that does not get there within the steps of its task counts
with what it took, and is not solved.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from bench.comparison import python_of
from turns import attend_rounds

# By task: the mean return, and the steps at most. Our preset has its name.
TASKS = {"cartpole": (195.0, 50_000), "minatar-breakout": (5.0, 150_000)}
# Steps an update, the same for everybody: those of Stable-Baselines3's zoo, whose Atari games stand in for MinAtar.
STEPS = {"cartpole": 2, "minatar-breakout": 4}
# The same for everybody, in place of our preset's.
PERIODS = {"minatar-breakout": 250}  # updates between two targets
RATES = {"minatar-breakout": 2e-3}
N_STEPS = {"minatar-breakout": 3}  # of a return
IN_JAX = ("jax", "rejax")
OURS = {"lockstep": ("coop-lockstep",), "distributed": ("coop-local", "--actors", "1")}


def run(who: str, preset: str, seed: int, folder: Path, *more: str, method: str = "coop") -> dict[str, Any]:
    """The summary of one run of ours."""
    name, *flags = OURS[who]
    flags += ["--preset", preset, "--method", method, "--seed", str(seed), "--run-dir", str(folder / "run"), *more]
    subprocess.run([str(Path(sys.executable).with_name(name)), *flags], check=True, stdout=subprocess.DEVNULL)
    summary: dict[str, Any] = json.loads((folder / "run" / "summary.json").read_text())
    return summary


def ours(who: str, task: str, method: str, seed: int, folder: Path) -> tuple[int, bool]:
    """Steps, and whether it got there."""
    mean, most = TASKS[task]
    flags = ["--replay.ratio", str(1 / STEPS[task]), "--target-return", str(mean), "--total-steps", str(most)]
    if task in PERIODS:
        period = "swap-every" if method == "coop" else "target-update-every"
        flags += [f"--learner.{period}", str(PERIODS[task]), "--learner.learning-rate", str(RATES[task])]
        flags += ["--replay.n-step", str(N_STEPS[task])]
    summary = run(who, task, seed, folder, *flags, method=method)
    return summary["env_steps"], summary["return_mean_100"] >= mean


def rival(who: str, task: str, seed: int) -> tuple[int, bool]:
    """The same of a script beside this one."""
    python = python_of("jax") if who in IN_JAX else sys.executable
    command = [str(python), str(Path(__file__).with_name(f"learn_{who}.py")), task, str(seed)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    steps, solved = json.loads(done.stdout.splitlines()[-1])
    return steps, solved


def main(who: str, task: str, method: str = "coop") -> None:
    def turn(seed: int) -> dict[str, float]:
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            steps, solved = ours(who, task, method, seed, Path(folder)) if who in OURS else rival(who, task, seed)
        return {"seconds": time.monotonic() - begun, "steps": steps, "solved": solved}

    attend_rounds(turn)


if __name__ == "__main__":
    main(*sys.argv[1:])
