"""The rules of results/minatar/edl/plan.md by which the runs of one phase decide what the next one plays.

Each takes the rows of the runs that are over, see `kept` in play.py.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

FEEDBACKS = ("transform", "weight-gradient")  # in the order in which they are tried
COSINE, RATIOS = 0.95, (0.9, 1.1)  # beyond which a feedback is on, in some layer
TIE = 0.01  # of a share: two that are nearer are as good
CELL = ["variant", "feedback", "capacity"]


def driven(rows: pd.DataFrame) -> pd.DataFrame:
    """Pilot: of each feedback and layer the median cosine and ratio over the second halves of all runs, and `on`."""
    found = []
    for feedback, part in rows[rows["phase"] == "pilot"].groupby("feedback", sort=False):
        late = [
            np.array((measure["cosine"], measure["ratio"]))
            for measures in part["measures"]
            for measure in measures
            if 2 * measure["update"] > max(each["update"] for each in measures)
        ]
        for layer, (cosine, ratio) in enumerate(np.median(late, axis=0).T, 1):
            on = cosine < COSINE or not RATIOS[0] <= ratio <= RATIOS[1]
            found.append({"feedback": feedback, "layer": layer, "cosine": cosine, "ratio": ratio, "on": bool(on)})
    return pd.DataFrame(found, columns=["feedback", "layer", "cosine", "ratio", "on"])


def feedbacks_on(rows: pd.DataFrame) -> list[str]:
    """The feedbacks of the pilot that are on in some layer."""
    table = driven(rows)
    return [name for name in FEEDBACKS if table.loc[table["feedback"] == name, "on"].any()]


def targets(rows: pd.DataFrame) -> pd.DataFrame:
    """Double: the mean of both kinds of targets over games, sizes and methods, in shares of the best of each cell.

    The column `chosen` marks the larger one; single targets if they are within TIE.
    """
    part = rows[rows["phase"] == "double"]
    means = part.groupby(["game", *CELL, "double"])["area"].mean().unstack("double")
    shares = means.div(means.groupby(["game", "capacity"]).max().max(axis=1), axis=0).mean()
    double = bool(shares[True] > shares[False] + TIE)
    return pd.DataFrame({"double": shares.index, "share": shares.to_numpy(), "chosen": shares.index == double})


def rates(rows: pd.DataFrame) -> pd.DataFrame:
    """Rates: of each variant, size and rate the mean over games of its share of the largest mean area there.

    The column `chosen` marks the rate of each variant and size with the largest share; of those within TIE of it, the
    smallest.
    """
    part = rows[rows["phase"] == "rates"]
    means = part.groupby([*CELL, "rate", "game"], sort=False)["area"].mean().unstack()
    shares = means.div(means.groupby("capacity").max()).mean(axis=1)
    near = shares >= shares.groupby(CELL, sort=False).transform("max") - TIE
    smallest = shares[near].reset_index().groupby(CELL, sort=False)["rate"].transform("min")
    chosen = shares[near].index[shares[near].reset_index()["rate"].to_numpy() == smallest.to_numpy()]
    return pd.DataFrame({"share": shares, "chosen": shares.index.isin(chosen)}).reset_index()
