"""The rules of the dissection of error-driven learning (results/cartpole/edl/plan.md), applied to its packed runs.

`python -m results.cartpole.edl.verdict` prints the tables of the page as Markdown, `figures` draws its figures; the
plan must be the one whose SHA-256 the packed file holds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtr

from coop.studies.report.intervals import Interval, over_seeds
from coop.studies.report.plots import Figure, Line, Panel
from results.cartpole.edl.packed import PLAN, registered, unpacked
from results.printing import command, print_tables

FILE = Path("results/cartpole/edl/dissection.parquet")
MARGIN = 3.0  # percent of none's mean area
LEVEL = 0.05
OPTIMIZERS = ("sgd", "rmsprop", "adam")
DEPTHS = (3, 8, 16)
FEEDBACKS = ("transform-constant", "transform-normal", "weight-gradient", "noise", "rates", "random")
JUDGED = ("transform-constant", "transform-normal")  # by the verdict on EDL under RMSProp and Adam
VANISHED, PLAIN, TIMES = 0.01, 0.1, 10.0  # family D: ratios of the first layer's norm to the last's, and of two ratios
MEASURES = ("gradient_ratio", "gradient_cosine", "step_ratio", "step_cosine", "least", "largest", "dead")
PHASES = ("study", "tuning", "layers")
AT = ("first", "fifth", "tenth", "last")  # of the 20 moments, those that are packed

Floats = NDArray[np.float64]


class Tests(NamedTuple):
    """The tests of a mean over seeds: p of the two-sided t test against 0, and of equivalence within MARGIN."""

    different: float
    equivalent: float


def tests_of(values: Floats) -> Tests:
    """Two-sided t test, and two one-sided t tests (TOST), of which the larger p counts."""
    count = len(values)
    mean, error = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(count)
    if error == 0:
        return Tests(1.0 if mean == 0 else 0.0, 0.0 if abs(mean) < MARGIN else 1.0)
    below, above = stdtr(count - 1, (mean - MARGIN) / error), stdtr(count - 1, -(mean + MARGIN) / error)
    return Tests(float(2 * stdtr(count - 1, -abs(mean) / error)), float(max(below, above)))


def holm(p: Sequence[float] | Floats) -> Floats:
    """Holm's adjusted p values, in the given order."""
    values = np.asarray(p, np.float64)
    order = values.argsort(kind="stable")
    adjusted = np.maximum.accumulate(values[order] * (len(values) - np.arange(len(values))))
    found = np.empty_like(values)
    found[order] = np.minimum(adjusted, 1)
    return found


def differences(runs: pd.DataFrame, area: str = "area") -> pd.DataFrame:
    """A row for each seed of each cell but none's: its difference to none's run of that seed, `percent` of none's mean.

    runs: those of the study. The mean of none is that over the seeds that the cell has.
    """
    keys = ["depth", "optimizer", "seed"]
    plain = runs[runs["condition"] == "none"][[*keys, area, "rate"]]
    plain = plain.rename(columns={area: "none", "rate": "none_rate"})
    both = runs[runs["condition"] != "none"].merge(plain, on=keys)
    base = both.groupby(["condition", "depth", "optimizer"])["none"].transform("mean")
    return both.assign(area=both[area], percent=100 * (both[area] - both["none"]) / base, base=base)


def compared(found: pd.DataFrame) -> pd.DataFrame:
    """A row for each cell: estimate and 95 % t interval in percent, and the p values of its tests; not corrected."""
    rows = []
    for (condition, depth, optimizer), part in found.groupby(["condition", "depth", "optimizer"]):
        values = part["percent"].to_numpy(np.float64)
        rows.append(
            {
                "feedback": condition, "depth": depth, "optimizer": optimizer, "rate": part["rate"].iloc[0],
                "none_rate": part["none_rate"].iloc[0], "none": part["base"].iloc[0],
                "area": float(part["area"].mean()), "percent": values.mean(),
                **dict(zip(("low", "high"), over_seeds(values)[1:], strict=True)), "seeds": len(values),
                **tests_of(values)._asdict(),
            }
        )  # fmt: skip
    table = pd.DataFrame(rows)
    places = [table["optimizer"].map(OPTIMIZERS.index), table["depth"], table["feedback"].map(FEEDBACKS.index)]
    return table.iloc[np.lexsort(places[::-1])].reset_index(drop=True)


def _outcome(row: pd.Series) -> str:
    if row["equivalent"] < LEVEL:
        return "equivalent"
    return "different" if row["different"] < LEVEL and abs(row["percent"]) > MARGIN else "undecided"


def family_a(found: pd.DataFrame) -> pd.DataFrame:
    """Equivalence under RMSProp and Adam; p values are Holm's, over the cells of either sort of test.

    Without `rates`: with these optimizers the program multiplied the steps of its runs, not their gradients.
    """
    table = compared(found[(found["optimizer"] != "sgd") & (found["condition"] != "rates")])
    table[["different", "equivalent"]] = table[["different", "equivalent"]].apply(holm)
    return table.assign(outcome=table.apply(_outcome, axis=1))


def verdict(table: pd.DataFrame) -> str:
    """On "EDL under RMSProp and Adam is off", from family A's outcomes of JUDGED."""
    outcomes = table[table["feedback"].isin(JUDGED)]["outcome"]
    if (outcomes == "different").any():
        return "fails"
    return (
        "holds" if len(outcomes) == len(JUDGED) * 2 * len(DEPTHS) and set(outcomes) == {"equivalent"} else "undecided"
    )


def step_rates(found: pd.DataFrame) -> pd.DataFrame:
    """Of `rates` under RMSProp and Adam as it ran, in no family: each layer's step times transform-constant's ratio."""
    return compared(found[(found["optimizer"] != "sgd") & (found["condition"] == "rates")])


def family_b(found: pd.DataFrame) -> pd.DataFrame:
    """Superiority under SGD."""
    table = compared(found[found["optimizer"] == "sgd"])
    table["different"] = holm(table["different"])
    sign = np.where(table["percent"] > 0, "better", "worse")
    return table.assign(outcome=np.where(table["different"] < LEVEL, sign, "undecided"))


def family_c(runs: pd.DataFrame, better: pd.DataFrame, area: str = "area") -> pd.DataFrame:
    """Mechanism under SGD: transform-constant minus rates and minus noise; `better`: family B's outcomes."""
    sgd = runs[runs["optimizer"] == "sgd"].pivot_table(area, ["depth", "seed"], "condition")
    rows = []
    for depth in DEPTHS:
        part = sgd.loc[depth].dropna(subset=["transform-constant", "rates", "noise", "none"])
        for other in ("rates", "noise"):
            values = (100 * (part["transform-constant"] - part[other]) / part["none"].mean()).to_numpy(np.float64)
            rows.append(
                {
                    "depth": depth, "minus": other, "percent": values.mean(),
                    **dict(zip(("low", "high"), over_seeds(values)[1:], strict=True)), "seeds": len(values),
                    **tests_of(values)._asdict(),
                }
            )  # fmt: skip
    table = pd.DataFrame(rows)
    table[["different", "equivalent"]] = table[["different", "equivalent"]].apply(holm)
    known = better[better["feedback"] == "transform-constant"].set_index("depth")["outcome"]
    return table.assign(outcome=[_mechanism(row, known[row["depth"]]) for _, row in table.iterrows()])


def _mechanism(row: pd.Series, known: str) -> str:
    if known != "better":
        return "none: transform-constant is not better than none"
    if row["equivalent"] < LEVEL:
        return "the same" if row["minus"] == "noise" else "it lengthens steps by layer"
    if row["different"] < LEVEL:
        return "better" if row["percent"] > 0 else "worse"
    return "undecided"


def family_d(runs: pd.DataFrame) -> pd.DataFrame:
    """Depth: medians over seeds of the ratio of the first layer's gradient to the last's under none, in percent.

    plain, driven: of the gradient, and of transform-constant's at the same weights; own: of transform-constant's in its
    own runs. Runs whose weights are not finite at a moment are not in its median.
    """
    rows = []
    for depth in DEPTHS:
        for optimizer in OPTIMIZERS:
            at = runs[(runs["depth"] == depth) & (runs["optimizer"] == optimizer)]
            none = at[at["condition"] == "none"]
            plain, driven = (100 * _medians(none[name]) for name in ("plain", "driven"))
            own = 100 * _medians(at[at["condition"] == "transform-constant"]["driven"])
            for moment, name in enumerate(AT):
                rows.append([depth, optimizer, name, plain[moment], driven[moment], own[moment]])
    return pd.DataFrame(rows, columns=["depth", "optimizer", "moment", "plain", "driven", "own"])


def vanishing(table: pd.DataFrame) -> str:
    """Family D's outcome from its rows of one optimizer at depth 16."""
    vanished = table["plain"] < 100 * VANISHED
    kept = table["driven"] >= TIMES * table["plain"]
    if (vanished & kept).sum() >= 2:
        return "holds"
    return "contradicted" if (table["plain"] > 100 * PLAIN).all() else "undecided"


def _medians(ratios: pd.Series) -> Floats:
    return np.asarray(np.nanmedian(np.stack(ratios.to_list()), axis=0), np.float64)


def chosen_rates(about: dict[str, Any]) -> pd.DataFrame:
    """A row for each tuned cell: the rate that was chosen, and the mean area of each rate, over the tuning's seeds."""
    names = {"transform": "transform-constant", "matched": "rates"}
    rows = []
    for key, value in about.items():
        depth, condition, optimizer = key.split(" ")
        areas = {f"area {number}": area for number, area in enumerate(value["areas"].values(), 1)}
        name = names.get(condition, condition)
        rows.append({"depth": int(depth), "feedback": name, "optimizer": optimizer, "rate": value["rate"]} | areas)
    return pd.DataFrame(rows)


def equal_rates(tuning: pd.DataFrame) -> pd.DataFrame:
    """Tuning: transform-constant minus none at each rate, paired by seed, with t intervals; areas, not percent."""
    wide = tuning.pivot_table("area", ["optimizer", "depth", "rate", "seed"], "condition")
    rows = []
    for (optimizer, depth, rate), part in wide.groupby(["optimizer", "depth", "rate"]):
        both = part[["transform-constant", "none"]].dropna()
        found = over_seeds((both["transform-constant"] - both["none"]).to_numpy(np.float64))
        rows.append([optimizer, depth, rate, both["none"].mean(), both["transform-constant"].mean(), *found, len(both)])
    columns = ["optimizer", "depth", "rate", "none", "transform", "difference", "low", "high", "seeds"]
    return pd.DataFrame(rows, columns=columns)


def secondary(study: pd.DataFrame) -> pd.DataFrame:
    """A row for each cell: means of area, last 100 returns and collapses, median steps to 195, and diverged runs."""
    groups = study.groupby(["condition", "depth", "optimizer"], sort=False)
    table = groups[["area", "recorded", "last", "collapses"]].mean()
    table["steps_to"] = groups["steps_to"].median()
    table["diverged"] = groups["finite"].agg(lambda finite: int((~finite.astype(bool)).sum()))
    table["seeds"] = groups.size()
    return table.reset_index().rename(columns={"condition": "feedback"})


class Data(NamedTuple):
    """The packed file, by phase; layers has a row for each cell, moment and measure."""

    study: pd.DataFrame
    tuning: pd.DataFrame
    layers: pd.DataFrame
    rates: dict[str, Any]


def load(path: Path = FILE) -> Data:
    """Raises ValueError if the plan beside the file is not the one that was in force."""
    rows, about = unpacked(path)
    if registered(path.with_name(PLAN)) != about["plan"]:
        raise ValueError(f"{path.with_name(PLAN)}: not the plan of {path.name}; changes go below its last heading")
    study, tuning, layers = (rows[rows["phase"] == name].dropna(axis=1, how="all") for name in PHASES)
    return Data(study, tuning, layers, about["rates"])


def tables(data: Data) -> dict[str, pd.DataFrame]:
    """All tables by name; "as recorded": family A with diverged runs' areas as played."""
    found = differences(data.study)
    b = family_b(found)
    recorded = differences(data.study, "recorded")
    return {
        "a": family_a(found), "step_rates": step_rates(found), "b": b, "c": family_c(data.study, b),
        "d": family_d(data.study), "layers": layers_table(data),
        "rates": chosen_rates(data.rates), "equal_rates": equal_rates(data.tuning), "secondary": secondary(data.study),
        "a_recorded": family_a(recorded), "b_recorded": family_b(recorded),
        "c_recorded": family_c(data.study, family_b(recorded), "recorded"),
    }  # fmt: skip


def forest(data: Data) -> Figure:
    """The difference of each feedback to none by optimizer and depth, with the margin of equivalence."""
    table, panels = compared(differences(data.study)), []
    for depth in DEPTHS:
        for optimizer in OPTIMIZERS:
            part = table[(table["depth"] == depth) & (table["optimizer"] == optimizer)].set_index("feedback")
            lines = []
            for place, name in enumerate(FEEDBACKS):
                if name in part.index:
                    row = part.loc[name]
                    values = Interval(*(np.array([row[each]]) for each in ("percent", "low", "high")))
                    lines.append(Line(name, np.array([float(place)]), values))
            title = f"{depth} layers, {optimizer}"
            panels.append(Panel(title, "", "percent of none's area", lines, True, ticks=FEEDBACKS, reference=0.0))
    text = "Feedback minus none, mean over seeds paired, 95 % t intervals, not corrected."
    return Figure("forest", "Area against none", text, "", panels)


def by_layer(data: Data, depth: int, moment: int = 2) -> Figure:
    """Medians over seeds, layer by layer, at one of the packed moments."""
    shown = {
        "gradient_ratio": "gradient: ratio", "gradient_cosine": "gradient: cosine", "step_cosine": "step: cosine",
        "largest": "largest singular value of T", "least": "smallest singular value of T", "dead": "dead units, share",
    }  # fmt: skip
    panels = []
    for measure, label in shown.items():
        lines = []
        for condition in ("none", "transform-constant"):
            for optimizer in OPTIMIZERS:
                medians = layers_of(data, condition, depth, optimizer, measure, moment)
                medians = medians[np.isfinite(medians)]
                nothing = np.full(len(medians), np.nan)
                layers = np.arange(1.0, len(medians) + 1)
                name = "EDL" if condition != "none" else condition
                lines.append(Line(f"{name} {optimizer}", layers, Interval(medians, nothing, nothing)))
        log = measure in ("gradient_ratio", "least", "largest")
        panels.append(Panel(label, "layer", "", lines, log_y=log, share=measure == "dead"))
    text = f"The {AT[moment]} of 20 moments; medians over seeds."
    return Figure(f"layers_{depth}", f"By layer, depth {depth}", text, "", panels)


def layers_of(data: Data, condition: str, depth: int, optimizer: str, measure: str, moment: int = 2) -> Floats:
    """The medians over seeds of a measure of a cell, one for each layer; nan where a layer has none."""
    where = {"condition": condition, "depth": depth, "optimizer": optimizer, "measure": measure, "moment": moment}
    (row,) = data.layers[(data.layers[list(where)] == pd.Series(where)).all(axis=1)].to_dict("records")
    return np.asarray(row["median"], np.float64)


def layers_table(data: Data) -> pd.DataFrame:
    """The extremes over layers of their medians over seeds, at the tenth of 20 moments."""
    rows = []
    for condition, depth, optimizer in product(("none", "transform-constant", "weight-gradient"), DEPTHS, OPTIMIZERS):
        if condition == "weight-gradient" and depth > min(DEPTHS):
            continue
        found = {name: layers_of(data, condition, depth, optimizer, name) for name in MEASURES}
        rows.append(
            {
                "feedback": condition, "depth": depth, "optimizer": optimizer,
                "longest": found["gradient_ratio"].max(), "cosine": found["gradient_cosine"].min(),
                "longest_step": found["step_ratio"].max(), "step_cosine": found["step_cosine"].min(),
                "least": np.nanmin(found["least"]), "largest": np.nanmin(found["largest"]),
                "dead": 100 * np.nanmax(found["dead"]),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def main() -> None:
    """Print the tables, or draw the figures."""
    command("results.cartpole.edl.verdict", __doc__, FILE, _print, lambda path: _figures(load(path)))


def _figures(data: Data) -> list[Figure]:
    return [forest(data), by_layer(data, 16)]


def _print(path: Path) -> None:
    found = tables(load(path))
    print_tables(found)
    print(f"\nEDL under RMSProp and Adam is off: {verdict(found['a'])}")
    for optimizer, part in found["d"][found["d"]["depth"] == max(DEPTHS)].groupby("optimizer", sort=False):
        print(f"vanishing at depth 16, {optimizer}: {vanishing(part)}")


if __name__ == "__main__":
    main()
