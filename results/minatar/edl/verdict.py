"""The rules of results/minatar/edl/plan.md on the outcome of the study, applied to its packed runs.

`python -m results.minatar.edl.verdict` prints, as Markdown, what the phases before it decided, as far as they are over,
and the study's tables once all of its cells are; `figures` draws the study's figure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtr

from coop.studies.report.intervals import over_seeds
from coop.studies.report.plots import Figure, Line, Panel, seed_lines
from results.cartpole.edl.verdict import holm
from results.minatar.edl import rules
from results.minatar.edl.play import FILE, EdlGrid, due, rows_of
from results.printing import command, print_tables

LARGE = 100_000  # transitions
MARGIN, LEVEL = 5.0, 0.05  # points: percent of dqn's mean area with LARGE in the same game
PAIRS = {
    "H1, equal updates in all": ("coop", "edql"),
    "H1, equal updates of a network": ("coop-2", "edql"),
    "H2, equal updates in all": ("g-coop", "dqn"),
    "H2, equal updates of a network": ("g-coop-2", "dqn"),
    "H3, one network": ("edql", "dqn"),
    "H3, two networks": ("coop", "g-coop"),
}
BESIDE = {"a second update, coop": ("coop-2", "coop"), "a second update, g-coop": ("g-coop-2", "g-coop")}  # no rule
FOR, EQUIVALENT, AGAINST, UNDECIDED = "for the claim", "equivalent", "against", "undecided"

Floats = NDArray[np.float64]


class Decision(NamedTuple):
    """A mean over seeds in points with its 95 % t interval, which of the three outcomes is nearest, and its p value.

    p is below LEVEL where the interval lies in the outcome's range.
    """

    points: float
    low: float
    high: float
    p: float
    nearest: str
    seeds: int


def decide(values: Floats) -> Decision:
    """The rule on the values of one pair, one of each seed."""
    count = len(values)
    mean, low, high = (float(each) for each in over_seeds(values))
    error = float(values.std(ddof=1)) / math.sqrt(count)
    beyond, short = (mean - MARGIN) / error, (mean + MARGIN) / error
    found = {
        FOR: stdtr(count - 1, -beyond),
        EQUIVALENT: max(stdtr(count - 1, beyond), stdtr(count - 1, -short)),
        AGAINST: stdtr(count - 1, short),
    }
    nearest = min(found, key=lambda name: found[name])
    return Decision(mean, low, high, min(1.0, 2 * float(found[nearest])), nearest, count)


def shares(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each variant and capacity: the share of each rate, and the rate that is chosen; see `rules.rates`."""
    table = rules.rates(rows)
    wide = table.assign(rate=table["rate"].map("{:g}".format)).pivot(index=rules.CELL, columns="rate", values="share")
    chosen = table[table["chosen"]].set_index(rules.CELL)["rate"]
    return wide.assign(chosen=chosen).reset_index()


def scores(rows: pd.DataFrame) -> pd.DataFrame:
    """The runs of the study with `points`."""
    runs = rows[rows["phase"] == "study"]
    large = runs[(runs["variant"] == "dqn") & (runs["capacity"] == LARGE)].groupby("game")["area"].mean()
    return runs.assign(points=100 * runs["area"] / runs["game"].map(large))


def differences(rows: pd.DataFrame, pairs: Mapping[str, tuple[str, str]] = PAIRS) -> pd.DataFrame:
    """A row for each pair, game and seed: the pair's difference with each capacity, and `points`, small minus large."""
    table = scores(rows).pivot_table("points", ["game", "seed"], ["variant", "capacity"])
    found = []
    for name, (one, other) in pairs.items():
        by_size = table[one] - table[other]
        small = min(by_size.columns)
        part = pd.DataFrame({"small": by_size[small], "large": by_size[LARGE]}).reset_index()
        found.append(part.assign(pair=name, points=part["small"] - part["large"]))
    return pd.concat(found, ignore_index=True)


def by_game(rows: pd.DataFrame) -> pd.DataFrame:
    """The rule on each pair in each game, by itself."""
    groups = differences(rows).groupby(["pair", "game"], sort=False)["points"]
    return _ruled({key: decide(values.to_numpy()) for key, values in groups}, ["pair", "game"])


def pooled(rows: pd.DataFrame) -> pd.DataFrame:
    """The rule on each pair, means over games of each seed; p by Holm over the pairs."""
    means = differences(rows).groupby(["pair", "seed"], sort=False)["points"].mean()
    decisions = {(pair,): decide(values.to_numpy()) for pair, values in means.groupby("pair", sort=False)}
    return _ruled(decisions, ["pair"], together=True)


def _ruled(found: Mapping[Any, Decision], names: list[str], *, together: bool = False) -> pd.DataFrame:
    table = pd.DataFrame([dict(zip(names, key, strict=True)) | each._asdict() for key, each in found.items()])
    if together:
        table["p"] = holm(table["p"])
    sign = np.where(table["low"] > 0, ", above 0", np.where(table["high"] < 0, ", below 0", ""))
    undecided = [UNDECIDED + each for each in sign]
    table["outcome"] = np.where(table["p"] < LEVEL, table["nearest"], undecided)
    return table.drop(columns="nearest")


def answer(table: pd.DataFrame) -> str:
    """Through what the buffer gets by with less, from the table of `pooled`."""
    by_hypothesis = table.groupby(table["pair"].str[:2])["outcome"].agg(set).to_dict()
    holds = {name for name, outcomes in by_hypothesis.items() if outcomes == {FOR}}
    if all(outcomes <= {EQUIVALENT, AGAINST} for outcomes in by_hypothesis.values()):
        return "none"
    found = [text for name, text in (("H2", "two networks"), ("H3", "error-driven learning")) if name in holds]
    if not found and "H1" in holds:
        found = ["both together"]
    return " and ".join(found) or "undecided"


def sizes(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each pair and size: mean over games of its difference there, with a t interval; beside the rule."""
    means = differences(rows, PAIRS | BESIDE).groupby(["pair", "seed"], sort=False)[["small", "large"]].mean()
    found = [
        (pair, size, *over_seeds(part[size].to_numpy()))
        for pair, part in means.groupby("pair", sort=False)
        for size in means
    ]
    return pd.DataFrame(found, columns=["pair", "size", "points", "low", "high"])


def areas(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean area of each variant, game and capacity with its standard deviation over seeds, and runs that diverged."""
    groups = scores(rows).groupby(["game", "capacity", "variant", "feedback", "rate"], sort=False)
    table = groups["area"].agg(["mean", "std", "count"])
    return table.assign(diverged=groups["finite"].agg(lambda finite: int((~finite).sum()))).reset_index()


def forest(rows: pd.DataFrame) -> Figure:
    """The outcome of each pair by game, and pooled, with each seed's value."""
    values, panels = differences(rows), []
    means = values.groupby(["pair", "seed"], sort=False)["points"].mean().reset_index()
    places = {name: float(place) for place, name in enumerate(PAIRS)}
    for title, part in [*values.groupby("game", sort=False), ("mean of both games", means)]:
        lines: list[Line] = []
        for name, group in part.groupby("pair", sort=False):
            lines += seed_lines(str(name), places[str(name)], group["points"].to_numpy(np.float64))
        panels.append(Panel(str(title), "", "points", lines, True, ticks=list(PAIRS), reference=0.0))
    text = f"Two minus one, 300 minus {LARGE:,} transitions; means over seeds with 95 % t intervals, and each seed."
    return Figure("forest", "What the small buffer costs", text, "", panels, same_y=True)


def main() -> None:
    """Print the tables, or draw the figure."""
    command("results.minatar.edl.verdict", __doc__, FILE, _print, lambda path: [forest(rows_of(None, path))])


def _print(path: Path) -> None:
    found = tables(rows_of(None, path))
    print_tables(found)
    if "pooled" in found:
        print(f"\nThe buffer gets by with less through: {answer(found['pooled'])}.")
    else:
        print("\nThe study is not complete.")


def tables(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """The tables of those phases of which all cells are over."""
    over = (set(rows["phase"]) if len(rows) else set()) - {cell.phase for cell in due(EdlGrid(), rows)}
    phases = {"pilot": rules.driven, "double": rules.targets, "rates": shares}
    found = {name: rule(rows) for name, rule in phases.items() if name in over}
    if "study" in over:
        found |= {"areas": areas(rows), "games": by_game(rows), "pooled": pooled(rows), "sizes": sizes(rows)}
    return found


if __name__ == "__main__":
    main()
