"""Tests whether two studies learn alike: `python benchmarks/agreement.py STUDY STUDY`, folders or packed studies.

For every method, both studies' returns against environment steps: the mean over runs (sd over runs) of the episodes
that ended in each tenth of the run. Then a permutation test on the area under each run's curve: the share of all
divisions of the runs into two groups of these sizes in which the mean areas are at least as far apart. A small share
means that the studies differ by more than seeds do.
"""

from __future__ import annotations

import argparse
import itertools
import tomllib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from experiments.report.packed import CONFIG, EPISODES
from experiments.report.sources import open_source

PARTS = 10

Curves = NDArray[np.float64]


def curves(folder: Path) -> dict[str, Curves]:
    """By method, mean returns float64 [runs, PARTS] of the runs in a folder or a packed study."""
    found: dict[str, list[list[float]]] = {}
    source = open_source(folder)
    for run in source.names:
        config = tomllib.loads(source.text(run, CONFIG) or "")
        steps, returns = np.array([*source.columns(run, EPISODES, ("env_step", "return")).values()], np.float64)
        part = np.minimum((steps.astype(int) - 1) * PARTS // config["total_steps"], PARTS - 1)
        found.setdefault(config["method"], []).append([float(returns[part == i].mean()) for i in range(PARTS)])
    return {method: np.array(runs) for method, runs in found.items()}


def permutation_share(first: Curves, second: Curves) -> float:
    """Share of the divisions of the runs in which the mean areas are at least as far apart as here."""
    areas, count = np.concatenate([first, second]).mean(1), len(first)
    gaps = []
    for chosen in itertools.combinations(range(len(areas)), count):
        mask = np.zeros(len(areas), bool)
        mask[list(chosen)] = True
        gaps.append(abs(areas[mask].mean() - areas[~mask].mean()))
    return float(np.mean(np.array(gaps) >= gaps[0] - 1e-12))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=Path)
    parser.add_argument("second", type=Path)
    options = parser.parse_args()
    one, other = curves(options.first), curves(options.second)
    for method in sorted(one.keys() & other.keys()):
        a, b = one[method], other[method]
        print(f"{method}: {len(a)} runs in {options.first.name}, {len(b)} in {options.second.name}")
        for i in range(PARTS):
            print(
                f"  tenth {i + 1:2d}   {a[:, i].mean():6.1f} ({a[:, i].std(ddof=1):5.1f})   "
                f"{b[:, i].mean():6.1f} ({b[:, i].std(ddof=1):5.1f})"
            )
        print(
            f"  area      {a.mean():6.1f} ({a.mean(1).std(ddof=1):5.1f})   {b.mean():6.1f} "
            f"({b.mean(1).std(ddof=1):5.1f})   permutation test p = {permutation_share(a, b):.2f}"
        )


if __name__ == "__main__":
    main()
