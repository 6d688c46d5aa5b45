"""The rules of results/cartpole/hold/plan.md, applied to its packed runs: E, P and the answer.

`python -m results.cartpole.hold.verdict` prints the tables of the complete cells as Markdown, `figures` draws the
figures; a rule whose cells are not complete says so. The plan and the grid must be those whose SHA-256 the packed file
holds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import NamedTuple, TypeGuard, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import betaincinv, stdtr
from scipy.stats import binomtest

from coop.studies.report.intervals import Interval, over_seeds
from coop.studies.report.plots import Figure, Line, Panel
from results.cartpole.edl.verdict import holm
from results.cartpole.hold.play import FILE, PACKED, SIZES
from results.printing import command, print_tables

ENDS_WELL, LEVEL, MARGIN = 195, 0.05, 0.25  # the margin in settings of four
EVICTIONS = ("fifo", "reservoir")
PAIRS = (("g-coop", "dqn"), ("coop", "edql"))  # two networks, one network
EDL = (("edql", "dqn"), ("coop", "g-coop"))
OTHERS = ("dqn", "half", "slow", "copy-acts", "one-actor")
SETTINGS = tuple(product(EVICTIONS, (300, 5000), (True,)))
SAYS = {
    "copy-acts": "a second network is not needed: acting by older weights is enough",
    "half": "fewer updates are enough",
    "slow": "a slower target is enough",
}
SHARES = f"Return of the last 100 episodes of {ENDS_WELL} or more; exact 95 % intervals."
CELL = ["variant", "double", "eviction", "capacity"]

Floats = NDArray[np.float64]
Found = TypeVar("Found")


def load(path: Path = FILE) -> pd.DataFrame:
    """A row for each run, with `well`: it ends well. Raises UsageError if plan or grid are not those of the file."""
    runs: pd.DataFrame = PACKED.table(path).to_pandas()
    return runs.assign(well=runs["last"] >= ENDS_WELL, collapsed=runs["collapses"] > 0)


def exact(hits: int, count: int) -> tuple[float, float]:
    """The exact (Clopper-Pearson) 95 % interval of a share."""
    low = 0.0 if hits == 0 else float(betaincinv(hits, count - hits + 1, LEVEL / 2))
    high = 1.0 if hits == count else float(betaincinv(hits + 1, count - hits, 1 - LEVEL / 2))
    return low, high


def mcnemar(one: Iterable[bool], other: Iterable[bool]) -> float:
    """The exact two-sided McNemar test of paired outcomes."""
    pairs = np.array([list(one), list(other)], bool)
    ups, downs = int((pairs[0] & ~pairs[1]).sum()), int((~pairs[0] & pairs[1]).sum())
    return float(binomtest(ups, ups + downs).pvalue) if ups + downs else 1.0


def cells(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each cell: shares with exact intervals, and what stands beside them without a rule."""
    rows = []
    for key, part in runs.groupby(CELL, sort=False):
        row: dict[str, object] = dict(zip(CELL, key, strict=True)) | {"seeds": len(part)}
        for name in ("well", "collapsed"):
            hits = int(part[name].sum())
            row |= {name: hits / len(part)} | dict(
                zip((f"{name}_low", f"{name}_high"), exact(hits, len(part)), strict=True)
            )
        area = over_seeds(part["area"].to_numpy(np.float64))
        row |= dict(zip(("area", "area_low", "area_high"), area, strict=True))
        row |= {
            "churn": part["churn"].mean(),
            "q_share": part["q_share"].mean(),
            "diverged": int((~part["finite"]).sum()),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def by_seed(runs: pd.DataFrame, variant: str, settings: Iterable[tuple[str, int, bool]]) -> pd.Series | None:
    """In how many of the settings (eviction, capacity, double) each seed ends well; None if a cell is missing."""
    found = []
    for eviction, capacity, double in settings:
        where = (runs["variant"] == variant) & (runs["eviction"] == eviction)
        part = runs[where & (runs["capacity"] == capacity) & (runs["double"] == double)]
        if part.empty:
            return None
        found.append(part.set_index("seed")["well"].astype(float))
    return pd.concat(found, axis=1, join="inner").sum(axis=1)


class Test(NamedTuple):
    """A mean over seeds with its 95 % t interval; p of the t test against 0, and of equivalence within MARGIN."""

    mean: float
    low: float
    high: float
    p: float
    equivalent: float
    seeds: int


def tested(values: Floats) -> Test:
    """Two-sided t test, and two one-sided ones (TOST), of which the larger p counts."""
    count = len(values)
    mean, low, high = (float(each) for each in over_seeds(values))
    error = float(values.std(ddof=1)) / math.sqrt(count)
    if error == 0:
        return Test(mean, mean, mean, float(mean == 0), 0.0 if abs(mean) < MARGIN else 1.0, count)
    below, above = stdtr(count - 1, (mean - MARGIN) / error), stdtr(count - 1, -(mean + MARGIN) / error)
    return Test(mean, low, high, float(2 * stdtr(count - 1, -abs(mean) / error)), float(max(below, above)), count)


def _all(found: dict[str, Found | None]) -> TypeGuard[dict[str, Found]]:
    return all(each is not None for each in found.values())


def evictions(runs: pd.DataFrame) -> pd.DataFrame | None:
    """Rule E: by eviction, two networks minus one in sizes of four, mean of both pairs; and fifo minus reservoir.

    Holm over the three; None if a cell of part 1 is missing.
    """
    differences = {}
    for eviction in EVICTIONS:
        found = _between(runs, PAIRS, [(eviction, size, True) for size in SIZES])
        if found is None:
            return None
        differences[eviction] = found
    differences["fifo - reservoir"] = differences["fifo"] - differences["reservoir"]
    table = pd.DataFrame([{"rule": name, **tested(each)._asdict()} for name, each in differences.items()])
    table["p"] = holm(table["p"])
    holds = (table["p"] < LEVEL) & (table["mean"] > 0)
    return table.drop(columns="equivalent").assign(outcome=np.where(holds, "two networks hold", "not shown"))


def parts(runs: pd.DataFrame, settings: Iterable[tuple[str, int, bool]] = SETTINGS) -> pd.DataFrame | None:
    """Rule P: g-coop minus each of the others, in settings of four; Holm over five. None if a cell is missing."""
    settings = list(settings)
    counts = {name: by_seed(runs, name, settings) for name in ("g-coop", *OTHERS)}
    if not _all(counts):
        return None
    rows = [{"g-coop minus": name, **tested((counts["g-coop"] - counts[name]).to_numpy())._asdict()} for name in OTHERS]
    table = pd.DataFrame(rows)
    table["p"] = holm(table["p"])
    different = np.where(table["mean"] > 0, "g-coop ends well more often", "g-coop ends well less often")
    outcome = np.where(table["p"] < LEVEL, different, "not shown")
    return table.assign(outcome=np.where(table["equivalent"] < LEVEL, "as good", outcome))


def answer(table: pd.DataFrame) -> list[str]:
    """The plan's sentences, from rule P's table."""
    rows = table.set_index("g-coop minus")
    as_good = set(rows.index[rows["equivalent"] < LEVEL])
    found = [text for name, text in SAYS.items() if name in as_good]
    actor = rows.loc["one-actor"]
    if actor["p"] < LEVEL and actor["mean"] > 0 and "copy-acts" in as_good:
        found.append("it is who acts")
    return found or ["it takes two networks"]


def settings_of(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each complete setting of part 2 and other variant: exact McNemar tests of g-coop against it."""
    rows = []
    for (eviction, capacity, double), name in product(SETTINGS, OTHERS):
        one, other = (by_seed(runs, each, [(eviction, capacity, double)]) for each in ("g-coop", name))
        if one is not None and other is not None:
            both = pd.concat((one, other), axis=1, join="inner").to_numpy().astype(bool)
            rows.append(
                {
                    "eviction": eviction, "capacity": capacity, "double": double, "g-coop against": name,
                    "g-coop": both[:, 0].mean(), "other": both[:, 1].mean(), "p": mcnemar(both[:, 0], both[:, 1]),
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def beside(runs: pd.DataFrame) -> pd.DataFrame:
    """What no rule names: means over seeds of differences in the share of runs that end well, with t intervals.

    Two networks minus one, mean of both pairs, by eviction and size, and with the two small sizes minus with the two
    large ones; EDL minus none, mean of both pairs, over all sizes.
    """
    rows = []
    for eviction in EVICTIONS:
        sizes = [(eviction, size, True) for size in SIZES]
        found = {f"{at[1]:,}": _between(runs, PAIRS, [at]) for at in sizes}
        found["EDL"] = _between(runs, EDL, sizes)
        if not _all(found):
            continue
        one, two, three, four = (found[f"{size:,}"] for size in SIZES)
        found |= {"small - large": (one + two - three - four) / 2, "EDL": found["EDL"] / len(SIZES)}
        rows += [[eviction, name, *(float(each) for each in over_seeds(values))] for name, values in found.items()]
    return pd.DataFrame(rows, columns=["eviction", "of", "mean", "low", "high"])


def _between(
    runs: pd.DataFrame, pairs: Iterable[tuple[str, str]], settings: list[tuple[str, int, bool]]
) -> Floats | None:
    """By seed, in how many settings more one method of a pair ends well than the other, mean of the pairs."""
    found = []
    for one, other in pairs:
        counts = {name: by_seed(runs, name, settings) for name in (one, other)}
        if not _all(counts):
            return None
        found.append((counts[one] - counts[other]).to_numpy(np.float64))
    return np.asarray(np.mean(found, axis=0))


def tables(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """All tables by name, as far as their cells are complete."""
    found = {
        "cells": cells(runs),
        "settings": settings_of(runs),
        "E": evictions(runs),
        "P": parts(runs),
        "beside": beside(runs),
    }
    return {name: table for name, table in found.items() if table is not None}


def ends_well(runs: pd.DataFrame) -> Figure:
    """Part 1: share of seeds that end well by capacity, eviction and method."""
    table, panels = cells(runs), []
    for eviction in EVICTIONS:
        lines = []
        for method in (name for pair in zip(*PAIRS, strict=True) for name in pair):
            part = table[(table["eviction"] == eviction) & (table["variant"] == method)].sort_values("capacity")
            lines.append(Line(method, part["capacity"].to_numpy(np.float64), _share(part)))
        panels.append(Panel(eviction, "capacity", "share of seeds", lines, True, sizes=True, share=True))
    return Figure("ends_well", "Runs that end well", SHARES, _counts(runs), panels, same_y=True)


def by_part(runs: pd.DataFrame) -> Figure:
    """Part 2: share of seeds that end well by setting and variant."""
    table, panels, shown = cells(runs), [], ("g-coop", *OTHERS)
    for eviction, capacity, _ in SETTINGS:
        part = table[(table["eviction"] == eviction) & (table["capacity"] == capacity)].set_index("variant")
        lines = [
            Line(name, np.array([float(place)]), _share(part.loc[[name]]))
            for place, name in enumerate(shown)
            if name in part.index
        ]
        title = f"{eviction}, {capacity:,} transitions"
        panels.append(Panel(title, "", "share of seeds", lines, True, share=True, ticks=shown))
    return Figure("parts", "Parts of having two networks", SHARES, _counts(runs), panels)


def _share(rows: pd.DataFrame) -> Interval:
    return Interval(*(rows[name].to_numpy(np.float64) for name in ("well", "well_low", "well_high")))


def _counts(runs: pd.DataFrame) -> str:
    return f"{runs['seed'].nunique()} seeds of each cell."


def figures(runs: pd.DataFrame) -> list[Figure]:
    """Those of the page."""
    return [ends_well(runs), by_part(runs)]


def main() -> None:
    """Print the tables and the answer, or draw the figures."""
    command("results.cartpole.hold.verdict", __doc__, FILE, _print, lambda path: figures(load(path)))


def _print(path: Path) -> None:
    found = tables(load(path))
    print_tables(found)
    if "P" in found:
        print(f"\nThe answer: {'; '.join(answer(found['P']))}.")
    if missing := {"E", "P"} - set(found):
        print(f"\nNot all cells are complete of the rules {', '.join(sorted(missing))}.")


if __name__ == "__main__":
    main()
