"""Tests whether every method solves catch within ten minutes: `python benchmarks/catch.py`.

Runs `coop-local --preset catch --method M --actors 1 --target-return 0.9` for each method, so a run stops once the
mean return of its last 100 episodes, played with the run's own epsilon, reaches 0.9 of the maximum of 1.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from common.process.processes import command
from common.process.summaries import read_summary

TARGET, LIMIT = 0.9, 600.0  # return; seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("methods", nargs="*", default=["dqn", "edql", "g-coop", "coop"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    options = parser.parse_args()
    failed = 0
    for method in options.methods:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder:
                flags = ["--method", method, "--seed", str(seed), "--target-return", str(TARGET), "--run-dir", folder]
                local = command("coop-local", "--preset", "catch", "--actors", "1", *flags)
                subprocess.run(local, stdout=subprocess.DEVNULL, check=True)
                summary = read_summary(Path(folder))
            reached, seconds = summary["return_mean_100"], summary["wall_seconds"]
            failed += reached < TARGET or seconds > LIMIT
            print(
                f"{method:7} seed {seed}: return {reached:.2f} after {summary['env_steps']:,} steps, "
                f"{summary['updates']:,} updates, {seconds:.0f} s",
                flush=True,
            )
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
