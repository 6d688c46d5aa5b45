"""The rules of the registered study, against numbers worked out by hand."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from coop.studies.report.study import load_study
from results.minatar.registered import LARGE, areas, losses, outcome, rates, scores, table_of, verdict

RESULTS = Path(__file__).parent.parent / "results"


def runs(areas: Mapping[tuple[str, str, int, float, int], float]) -> pd.DataFrame:
    """Runs by (method, game, capacity, rate, seed)."""
    rows = [(*place, area) for place, area in areas.items()]
    return pd.DataFrame(rows, columns=["method", "game", "capacity", "rate", "seed", "area"])


def test_small_is_the_size_whose_loss_is_nearest_to_45_percent() -> None:
    means = {
        "A": {300: 2.0, 1000: 5.6, 3000: 9.0, LARGE: 10.0},  # losses 80, 44, 10
        "B": {300: 10.0, 1000: 12.0, 3000: 30.0, LARGE: 20.0},  # losses 50, 40, -50: 300 and 1000 are equally near
    }
    table = losses(
        runs(
            {
                ("dqn", game, capacity, 1e-3, seed): mean + (seed - 0.5)
                for game, each in means.items()
                for capacity, mean in each.items()
                for seed in (0, 1)
            }
        )
    )
    assert table["loss"].tolist() == pytest.approx([80, 44, 10, 0, 50, 40, -50, 0])
    assert table["sd"].tolist() == pytest.approx([0.5**0.5] * 8)
    assert table[table["small"]][["game", "capacity"]].to_numpy().tolist() == [["A", 1000], ["B", 300]]


def test_a_method_takes_the_rate_with_the_largest_mean_share() -> None:
    areas = {  # the largest: 10 in A, 100 in B
        ("dqn", "A", 1e-3): 10.0, ("dqn", "B", 1e-3): 50.0,  # 100 % and 50 %
        ("dqn", "A", 5e-4): 7.0, ("dqn", "B", 5e-4): 90.0,  # 70 % and 90 %
        ("coop", "A", 1e-3): 6.0, ("coop", "B", 1e-3): 100.0,  # 60 % and 100 %
        ("coop", "A", 5e-4): 9.0, ("coop", "B", 5e-4): 65.0,  # 90 % and 65 %
    }  # fmt: skip
    table = rates(runs({(m, g, LARGE, r, seed): a for (m, g, r), a in areas.items() for seed in (110, 111)}))
    assert table["mean"].tolist() == pytest.approx([75, 80, 80, 77.5])
    assert table["chosen"].tolist() == [False, True, True, False]


def study_runs(
    small: Mapping[str, float], large: Mapping[str, float], *, seeds: int = 3, edql: bool = True
) -> pd.DataFrame:
    """Areas that are the same for all seeds; in game B everything is ten times as much."""
    sizes = {300: small, LARGE: large}
    return runs(
        {
            (method, game, capacity, 1e-3, seed): area * (10 if game == "B" else 1)
            for game in "AB"
            for capacity, methods in sizes.items()
            for method, area in methods.items()
            for seed in range(seeds)
            if edql or method != "edql"
        }
    )


def test_the_primary_outcome() -> None:
    small = {"dqn": 3.0, "edql": 2.0, "g-coop": 3.5, "coop": 4.0}  # in points of dqn's 5: 60, 40, 70, 80
    large = {"dqn": 5.0, "edql": 6.0, "g-coop": 4.5, "coop": 5.0}  # 100, 120, 90, 100
    table = outcome(study_runs(small, large)).set_index(["difference", "size"])
    points = table["points"]
    assert points["coop - edql"].tolist() == pytest.approx([40, -20, 60])
    assert points["g-coop - dqn"].tolist() == pytest.approx([10, -10, 20])
    assert points["two networks - one"].tolist() == pytest.approx([25, -15, 40])
    assert table["low"].tolist() == pytest.approx(points.tolist())  # the same for all seeds
    compared = outcome(pd.concat([study_runs(small, large), without_buffer(1.0)]))
    pd.testing.assert_frame_equal(compared.set_index(["difference", "size"]), table)
    without = outcome(study_runs(small, large, edql=False)).set_index(["difference", "size"])["points"]
    assert without["two networks - one"].tolist() == pytest.approx([10, -10, 20])


def without_buffer(area: float) -> pd.DataFrame:
    return runs({("stream-q", game, 0, 1.0, seed): area for game in "AB" for seed in range(3)})


def test_scores_are_percent_of_dqn_with_the_large_buffer() -> None:
    table = study_runs({"dqn": 3.0}, {"dqn": 5.0}, edql=False)
    table.loc[(table["seed"] == 2) & (table["capacity"] == 300) & (table["game"] == "A"), "area"] = 6.0
    found = scores(pd.concat([table, without_buffer(2.5)])).set_index(["method", "size"])
    assert found["A"].tolist() == pytest.approx([4.0, 5.0, 2.5])  # (3 + 3 + 6) / 3
    assert found["B"].tolist() == pytest.approx([30.0, 50.0, 2.5])
    assert found["score"].tolist() == pytest.approx([70.0, 100.0, 27.5])  # by seed: 60, 60, 90; (50 + 5) / 2
    assert found["sd"].tolist() == pytest.approx([300**0.5, 0, 0])
    assert found.index.tolist() == [("dqn", "small"), ("dqn", "large"), ("stream-q", "none")]


def test_the_interval_resamples_whole_seeds() -> None:
    table = study_runs({"dqn": 3.0, "g-coop": 4.0}, {"dqn": 5.0, "g-coop": 5.0}, seeds=2, edql=False)
    small = (table["method"] == "g-coop") & (table["capacity"] != LARGE)
    table.loc[small & (table["seed"] == 0), "area"] *= 2  # 160 for 80 points, so seed 0 has 100 more than 60, seed 1 20
    found = outcome(table).set_index(["difference", "size"]).loc[("g-coop - dqn", "small")]
    assert tuple(found[["low", "points", "high"]]) == pytest.approx((20, 60, 100))  # of two seeds drawn twice
    scaled = (table["seed"] == 0) & (table["capacity"] != LARGE)
    table.loc[scaled, "area"] += 1.0 * table["game"].map({"A": 1, "B": 10})  # of both methods: pairs stay as they are
    again = outcome(table).set_index(["difference", "size"]).loc[("g-coop - dqn", "small")]
    assert tuple(again[["low", "points", "high"]]) == pytest.approx((20, 60, 100))
    up = small & (table["game"] == "A")
    table.loc[up, "area"] += table["seed"].map({0: -3.0, 1: 3.0})  # 60 points; the other game's go the other way
    table.loc[small & (table["game"] == "B"), "area"] += table["seed"].map({0: 30.0, 1: -30.0})
    once_more = outcome(table).set_index(["difference", "size"]).loc[("g-coop - dqn", "small")]
    assert tuple(once_more[["low", "points", "high"]]) == pytest.approx((20, 60, 100))


def test_an_unfinished_method_is_left_out_unless_it_is_needed() -> None:
    study = load_study(RESULTS / "cartpole" / "methods.parquet")
    whole = areas(study)
    lacking = replace(study, missing={"coop-seed=9": "not begun"})
    with pytest.raises(ValueError, match="coop-seed=9"):
        areas(lacking)
    with pytest.raises(ValueError, match="not finished: coop-seed=9"):
        areas(lacking, ["dqn", "coop"])
    without = areas(lacking, ["dqn", "g-coop"])
    pd.testing.assert_frame_equal(without, whole[whole["method"] != "coop"].reset_index(drop=True))
    with pytest.raises(ValueError, match="coop-seed=9"):
        table_of("scores", lacking)


@pytest.mark.parametrize(
    ("points", "low", "high", "expected"),
    [
        (12, 1, 25, "confirmed"),
        (10, 0.1, 20, "confirmed"),
        (9.9, 1, 25, "inconclusive"),
        (12, 0, 25, "inconclusive"),
        (3, -4, 9.9, "denied"),
        (3, -4, 10, "inconclusive"),
        (5, 1, 9, "denied"),
    ],
)
def test_the_verdict(points: float, low: float, high: float, expected: str) -> None:
    assert verdict(points, low, high) == expected
