"""Tables of the results' pages that compare methods at equal updates, and how steady their networks are.

`python results/controls.py updates|networks|fresh FILE` prints one of a packed study.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from coop.common.settings.config import value_of
from coop.studies.report.comparisons import paired_table
from coop.studies.report.intervals import over_seeds
from coop.studies.report.measures import diagnostic, score
from coop.studies.report.study import CHURN, Q_SHARE, Study, load_study

PAIRS = (("g-coop", "dqn"), ("coop", "edql"))  # two networks, one network
# Updates a step of two networks together and of one: equal work, then equal updates of each network.
RATIOS = ((1.0, 1.0), (2.0, 2.0), (2.0, 1.0), (1.0, 0.5))
POOLED = "two networks - one"
FRESH = 10  # the first seed of `authors` that `authors-buffers` has not


def updates(study: Study) -> pd.DataFrame:
    """Two networks minus one at equal work and at equal updates of each network: small, large, and their difference.

    Returns of the last 100 episodes, means over the seeds that have all of them, 95 % t intervals over seeds; pooled:
    the mean of both pairs, by seed.
    """
    rows = [
        (
            run.config.method,
            value_of(run.config, "replay.ratio"),
            run.config.replay.capacity,
            run.config.seed,
            score(run),
        )
        for run in study.runs
    ]
    frame = pd.DataFrame(rows, columns=["method", "ratio", "capacity", "seed", "score"])
    values = frame.pivot_table("score", "seed", ["method", "ratio", "capacity"])
    made = []
    for two, one in RATIOS:
        by_pair = {
            f"{x} - {y}": {size: values[x, two, size] - values[y, one, size] for size in (100, 5000)} for x, y in PAIRS
        }
        by_pair[POOLED] = {size: sum(each[size] for each in by_pair.values()) / len(PAIRS) for size in (100, 5000)}
        for name, sizes in by_pair.items():
            apart = {"small": sizes[100], "large": sizes[5000], "small - large": sizes[100] - sizes[5000]}
            for what, each in apart.items():
                made.append([f"{two:g} : {one:g}", name, what, *over_seeds(each.dropna().to_numpy()), each.count()])
    return pd.DataFrame(made, columns=["updates", "difference", "size", "value", "low", "high", "seeds"])


def networks(study: Study) -> pd.DataFrame:
    """Of each method, and of two networks and of one: churn and mean |Q|, of the second half of each run.

    churn: the share of greedy actions that changes in 200 updates, those from one row of metrics to the next.
    per_network: the same in 100 updates of that network. ends: churn of the last fifth of the rows.
    q_share: mean |Q| as a share of its bound.
    """
    rows = []
    for run in study.runs:
        if run.config.method not in [name for pair in PAIRS for name in pair]:
            continue
        churn = run.metrics["policy_churn"]
        churn = churn[~np.isnan(churn)]
        if len(churn):
            rows.append(
                {
                    "networks": "two" if run.config.two_networks else "one",
                    "method": run.config.method,
                    "game": run.config.env.id.removeprefix("MinAtar/").removesuffix("-v1"),
                    "churn": diagnostic(run, "policy_churn"),
                    "ends": float(churn[-max(1, len(churn) // 5) :].mean()),
                    "per_network": diagnostic(run, CHURN),
                    "q_share": diagnostic(run, Q_SHARE),
                }
            )
    frame = pd.DataFrame(rows)
    means = ["churn", "ends", "per_network", "q_share"]
    return pd.concat(
        [frame.groupby([*by, "game"])[means].mean().reset_index() for by in (["networks"], ["networks", "method"])]
    )


def fresh(study: Study) -> pd.DataFrame:
    """The differences over the same seeds of those runs that no other study has."""
    return paired_table(replace(study, runs=tuple(run for run in study.runs if run.config.seed >= FRESH))).frame


TABLES = {"updates": updates, "networks": networks, "fresh": fresh}


def main() -> None:
    """Print a table of a packed study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("file", type=Path, help="packed study")
    args = parser.parse_args()
    table = TABLES[args.table](load_study(args.file))
    print(table.to_string(index=False, float_format="{:.6g}".format))


if __name__ == "__main__":
    main()
