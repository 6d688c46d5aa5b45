"""The rules of the registered MinAtar study (results/minatar/plan.md), applied to packed studies.

`python results/minatar/registered.py pilot|rates|scores|outcome|games FILE` prints a table of the plan and what it
decides; `figure FILE` draws the outcome by game. SHA256SUMS lists plan and studies.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pandas as pd

from coop.common.settings.config import value_of
from coop.common.settings.methods import METHODS
from coop.studies.report.intervals import over_seeds
from coop.studies.report.learning import area
from coop.studies.report.plots import Figure, Line, Panel, draw, seed_lines
from coop.studies.report.study import Study, load_study

LARGE = 100_000  # transitions
LOSS = 45.0  # percent, of dqn's area at LARGE: "small" is the capacity whose loss is nearest
ENOUGH = 10.0  # points: the least advantage that confirms the hypothesis
RESAMPLES = 10_000
PRIMARY = "two networks - one"
PAIRS = (("coop", "edql"), ("g-coop", "dqn"))  # two networks, one network
NEEDED = {method for pair in PAIRS for method in pair}


def areas(study: Study, needed: Collection[str] = ()) -> pd.DataFrame:
    """A row for each run: method, game, capacity (0 without a replay buffer), learning rate, seed and area.

    needed: methods that must be complete; another one that is not is left out. If it is empty, all must be.

    Raises ValueError if a run of these diverged or is missing, since the plan says otherwise than the report how it
    counts.
    """
    unfinished = [*study.diverged, *study.missing]
    of_method = {method: [name for name in unfinished if name.startswith(f"{method}-")] for method in METHODS.names()}
    if problem := [name for method in needed for name in of_method[method]] if needed else unfinished:
        raise ValueError(f"not finished: {', '.join(problem)}")
    rows = [
        {
            "method": run.config.method,
            "game": run.config.env.id.removeprefix("MinAtar/").removesuffix("-v1"),
            "capacity": value_of(run.config, "replay.capacity") if run.config.method in study.buffered else 0,
            "rate": value_of(run.config, "learner.learning_rate"),
            "seed": run.config.seed,
            "area": area(run),
        }
        for run in study.runs
        if not of_method[run.config.method]
    ]
    return pd.DataFrame(rows)


def losses(runs: pd.DataFrame) -> pd.DataFrame:
    """Pilot: of each game and capacity the mean area, its standard deviation, and the loss against LARGE in percent.

    The column `small` marks the capacity of each game whose loss is nearest to LOSS; of two equally near, the smaller.
    """
    groups = runs.groupby(["game", "capacity"])["area"]
    table = pd.DataFrame({"area": groups.mean(), "sd": groups.std()}).reset_index()
    large = table[table["capacity"] == LARGE].set_index("game")["area"]
    table["loss"] = 100 * (1 - table["area"] / table["game"].map(large))
    candidates = table[table["capacity"] < LARGE]
    distances = (candidates["loss"] - LOSS).abs()
    table["small"] = table.index.isin(distances.groupby(candidates["game"]).idxmin())
    return table


def rates(runs: pd.DataFrame) -> pd.DataFrame:
    """Rates: of each method and rate the share of each game's largest mean area, in percent, and their mean.

    The column `chosen` marks the rate of each method with the largest mean.
    """
    means = runs.groupby(["method", "rate", "game"], sort=False)["area"].mean().unstack()
    shares = 100 * means / means.max()
    shares["mean"] = shares.mean(axis=1)
    best = shares["mean"].groupby("method").idxmax()
    shares["chosen"] = shares.index.isin(best)
    return shares.reset_index()


def points(runs: pd.DataFrame) -> pd.DataFrame:
    """Study: the runs with `score`, their area in percent of dqn's mean area at LARGE in the same game, and `size`."""
    large = runs[(runs["method"] == "dqn") & (runs["capacity"] == LARGE)].groupby("game")["area"].mean()
    size = runs["capacity"].map({0: "none", LARGE: "large"}).fillna("small")
    return runs.assign(score=100 * runs["area"] / runs["game"].map(large), size=size)


def scores(runs: pd.DataFrame) -> pd.DataFrame:
    """Study: of each method and size the mean area in each game, and the mean score over games with its deviation.

    The standard deviation is that over seeds, of their means over games.
    """
    found = points(runs)
    by_seed = found.groupby(["method", "size", "seed"], sort=False)["score"].mean()
    groups = by_seed.groupby(["method", "size"], sort=False)
    means = found.groupby(["method", "size", "game"], sort=False)["area"].mean().unstack()
    return means.assign(score=groups.mean(), sd=groups.std()).reset_index()


def outcome(runs: pd.DataFrame) -> pd.DataFrame:
    """Study: the primary outcome and what stands beside it, in points.

    Primary: two networks minus one, the mean over PAIRS, at the small size minus the same at LARGE, mean over games.
    low, high: the plan's percentile bootstrap over seeds, by which it is decided; t_low, t_high: the t interval, since
    such a bootstrap of five seeds covers 84 %, not 95 %.
    """
    rows = [
        [name, what, *_estimate(each.to_numpy(np.float64)), *over_seeds(each.to_numpy(np.float64))[1:], len(each)]
        for name, sizes in _differences(points(runs)).items()
        for what, each in sizes.items()
    ]
    return pd.DataFrame(rows, columns=["difference", "size", "points", "low", "high", "t_low", "t_high", "seeds"])


def _differences(found: pd.DataFrame) -> dict[str, dict[str, pd.Series]]:
    """By difference and size, a value of each seed: the mean over the games in `found`, which is from `points`."""
    scores = found.set_index(["method", "game", "size", "seed"])["score"].unstack("method")
    pairs = {f"{two} - {one}": scores[two] - scores[one] for two, one in PAIRS if two in scores and one in scores}
    both = {PRIMARY: sum(pairs.values()) / len(pairs), **pairs}
    if "medqn" in scores:
        both["medqn - dqn"] = scores["medqn"] - scores["dqn"]
    made = {}
    for name, values in both.items():
        by_size = values.groupby(["seed", "size"]).mean().unstack()
        small, large = by_size["small"], by_size["large"]
        made[name] = {"small": small, "large": large, "small - large": small - large}
    return made


def games(runs: pd.DataFrame) -> pd.DataFrame:
    """Study: the differences of `outcome` in each game by itself, with 95 % t intervals over seeds."""
    found = points(runs)
    tables = []
    for game in sorted(set(runs["game"])):
        rows = [
            [name, what, *over_seeds(each.to_numpy(np.float64)), len(each)]
            for name, sizes in _differences(found[found["game"] == game]).items()
            for what, each in sizes.items()
        ]
        tables.append(pd.DataFrame(rows, columns=["difference", "size", "points", "low", "high", "seeds"]))
        tables[-1].insert(0, "game", game)
    return pd.concat(tables, ignore_index=True)


def forest(runs: pd.DataFrame) -> Figure:
    """Study: the differences between two networks and one in each game, and of each seed."""
    found, panels = points(runs), []
    for game in sorted(set(runs["game"])):
        lines: list[Line] = []
        ticks: list[str] = []
        rows = _differences(found[found["game"] == game])
        for name in (PRIMARY, *(f"{two} - {one}" for two, one in PAIRS)):
            for size in ("small - large", "small", "large"):
                label = f"{name}: {size}"
                lines += seed_lines(label, float(len(ticks)), rows[name][size].to_numpy(np.float64))
                ticks.append(label)
        panels.append(Panel(game, "", "points of dqn's area with 100,000", lines, True, ticks=ticks, reference=0.0))
    text = "Means over five seeds and their 95 % t intervals; small dots: the seeds. small: 300 transitions."
    return Figure("outcome", "Two networks minus one", text, "", panels)


def verdict(points: float, low: float, high: float) -> str:
    """The registered rule on the primary outcome."""
    if low > 0 and points >= ENOUGH:
        return "confirmed"
    return "denied" if high < ENOUGH else "inconclusive"


def _estimate(values: np.ndarray) -> tuple[float, float, float]:
    """Mean over seeds with its percentile bootstrap interval."""
    drawn = np.random.default_rng(0).choice(values, (RESAMPLES, len(values))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(values.mean()), float(low), float(high)


RULES = {"pilot": losses, "rates": rates, "scores": scores, "outcome": outcome, "games": games}


def table_of(rule: str, study: Study) -> pd.DataFrame:
    """The table of one of RULES; those of the study itself need the methods of the primary outcome."""
    return RULES[rule](areas(study, NEEDED if rule in ("scores", "outcome", "games") else ()))


def main() -> None:
    """Print the table of a rule for a packed study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("rule", choices=[*RULES, "figure"])
    parser.add_argument("file", type=Path, help="packed study")
    args = parser.parse_args()
    if args.rule == "figure":
        path = args.file.with_suffix("") / "report" / "outcome.png"
        draw(forest(areas(load_study(args.file), NEEDED)), path)
        print(path)
        return
    table = table_of(args.rule, load_study(args.file))
    print(table.to_string(index=False, float_format="{:.6g}".format))
    if args.rule == "outcome":
        primary = table[(table["difference"] == PRIMARY) & (table["size"] == "small - large")]
        print(verdict(*primary[["points", "low", "high"]].iloc[0]))


if __name__ == "__main__":
    main()
