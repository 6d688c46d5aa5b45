"""What checksums and flushes cost: `python benchmarks/durability.py OLD`, OLD: a checkout of the code to compare with.

Both take turns, so that ratios hold on a busy machine. A lockstep run of CartPole with a checkpoint every 1,000 and
every 100,000 steps gives steps/s and the seconds of a checkpoint (its own, and of processor time, which other load
affects less); `benchmarks/journal.py` of each gives inserts/s with the journal.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

HERE = Path(__file__).parents[1]
LOCKSTEP = "import sys; from coop.lockstep.cli import main; sys.argv[0] = 'coop-lockstep'; main()"
Figures = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=20_000)
    options = parser.parse_args()
    trees = {"old": options.old.resolve(), "new": HERE}
    taken: dict[str, list[Figures]] = {name: [] for name in trees}
    for number in range(options.rounds):
        for name in sorted(trees, reverse=bool(number % 2)):
            taken[name].append({**lockstep(trees[name], options.steps), **journal(trees[name])})
    print("| | old | new | new / old |\n| --- | ---: | ---: | ---: |")
    for figure in taken["new"][0]:
        old, new = ([turn[figure] for turn in taken[name]] for name in trees)
        ratios = [after / before for before, after in zip(old, new, strict=True)]
        print(f"| {figure} | {shown(old)} | {shown(new)} | {shown(ratios)} |")


def lockstep(tree: Path, steps: int) -> Figures:
    """Steps/s with few and with many checkpoints, and what one of these takes."""
    wall, processor = {}, {}
    for every in (1_000, 100_000):
        with tempfile.TemporaryDirectory(dir=HERE) as folder:  # on a disk, not in memory
            flags = [f"--total-steps={steps}", f"--checkpoint-every={every}", f"--run-dir={folder}/run"]
            wall[every], processor[every] = run(tree, ["-c", LOCKSTEP, "--preset=cartpole", *flags])
    saved = steps // 1_000 - 1  # beside the closing one
    return {
        "steps/s, a checkpoint every 100,000 steps": steps / wall[100_000],
        "steps/s, a checkpoint every 1,000 steps": steps / wall[1_000],
        "seconds of a checkpoint": max(1e-4, (wall[1_000] - wall[100_000]) / saved),
        "processor seconds of a checkpoint": max(1e-4, (processor[1_000] - processor[100_000]) / saved),
    }


def journal(tree: Path) -> Figures:
    """Inserts/s with the journal, and their processor time."""
    flags = [str(tree / "benchmarks" / "journal.py"), "--rounds", "4", "--seconds", "1"]
    out = subprocess.run([sys.executable, *flags], env=environment(tree), capture_output=True, text=True, check=True)
    found = re.search(r"with journal\s+([\d,]+) .*?transitions/s, ([\d.]+) ", out.stdout)
    assert found is not None, out.stdout
    return {
        "transitions/s inserted, with the journal": float(found[1].replace(",", "")),
        "us of processor time for each": float(found[2]),
    }


def run(tree: Path, arguments: Sequence[str]) -> tuple[float, float]:
    """Seconds, and seconds of processor time, of a process."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run([sys.executable, *arguments], env=environment(tree), stdout=subprocess.DEVNULL, check=True)
    after, took = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - began
    return took, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def environment(tree: Path) -> Mapping[str, str]:
    """The variables of a process that imports the code of a checkout."""
    folders = (tree, tree / "benchmarks", tree / "tests")
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders)), "OMP_NUM_THREADS": "1"}


def shown(values: Sequence[float]) -> str:
    """Median (lowest to highest)."""
    middle, least, most = (
        f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
        for value in (statistics.median(values), min(values), max(values))
    )
    return f"{middle} ({least} to {most})"


if __name__ == "__main__":
    main()
