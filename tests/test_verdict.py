"""The rules of the dissection of EDL: tests against scipy, cells with known answers, and what its page says."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy import stats

from results.cartpole.edl import packed, verdict

RESULTS = Path(__file__).parent.parent / "results"
EDL = RESULTS / "cartpole" / "edl"


def test_the_tests_are_scipys() -> None:
    rng = np.random.default_rng(0)
    for mean, spread, count in ((0.0, 2.0, 44), (2.5, 4.0, 10), (-3.5, 1.0, 26), (40.0, 9.0, 8)):
        values = mean + spread * rng.standard_normal(count)
        found = verdict.tests_of(values)
        assert found.different == pytest.approx(stats.ttest_1samp(values, 0).pvalue, rel=1e-9)
        sides = (
            stats.ttest_1samp(values, 3, alternative="less").pvalue,
            stats.ttest_1samp(values, -3, alternative="greater").pvalue,
        )
        assert found.equivalent == pytest.approx(max(sides), rel=1e-9)
    assert verdict.tests_of(np.zeros(5)) == (1.0, 0.0)
    assert verdict.tests_of(np.full(5, 4.0)) == (0.0, 1.0)


def test_holm_by_hand() -> None:
    # Sorted 0.01, 0.02, 0.03, 0.04 times 4, 3, 2, 1: 0.04, 0.06, 0.06 and 0.04, which is raised to 0.06.
    assert verdict.holm([0.03, 0.01, 0.04, 0.02]).tolist() == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert verdict.holm([0.9, 0.8]).tolist() == [1.0, 1.0]


SHIFTS = {
    ("transform-constant", "rmsprop"): 0.0, ("transform-normal", "rmsprop"): 10.0, ("noise", "rmsprop"): 2.9,
    ("rates", "rmsprop"): 50.0, ("transform-constant", "sgd"): 20.0, ("rates", "sgd"): 20.0, ("noise", "sgd"): -5.0,
}  # fmt: skip


def made_up(shifts: dict[tuple[str, str], float], spread: float = 1.0) -> pd.DataFrame:
    """Areas of 100 and the shifts, which are then percent, with deviations over 20 seeds that sum to 0."""
    off = np.tile([-spread, spread], 10)
    conditions = [("none", name) for name in ("rmsprop", "sgd")]
    rows = [
        {
            "condition": condition, "depth": depth, "optimizer": optimizer, "seed": seed,
            "area": 90.5 + 10 * (seed % 3) + shifts.get((condition, optimizer), 0) + (condition != "none") * off[seed],
            "rate": 0.01,
        }
        for depth in verdict.DEPTHS
        for condition, optimizer in (*conditions, *shifts)
        for seed in range(20)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_families_on_made_up_runs() -> None:
    runs = made_up(SHIFTS)
    found = verdict.differences(runs)
    a = verdict.family_a(found)
    at_3 = a[a["depth"] == 3].set_index("feedback")
    assert at_3["outcome"].to_dict() == {
        "transform-constant": "equivalent",
        "transform-normal": "different",
        "noise": "undecided",
    }
    assert at_3["percent"].tolist() == pytest.approx([0, 10, 2.9], abs=1e-9)
    assert len(a) == 9  # rates with RMSProp are in no family
    assert verdict.step_rates(found)["percent"].tolist() == pytest.approx([50] * 3)
    b = verdict.family_b(found)
    outcomes = {"transform-constant": "better", "rates": "better", "noise": "worse"}
    assert b[b["depth"] == 8].set_index("feedback")["outcome"].to_dict() == outcomes
    c = verdict.family_c(runs, b).set_index(["depth", "minus"])["outcome"]
    assert c[16, "rates"] == "it lengthens steps by layer"
    assert c[16, "noise"] == "better"
    same = verdict.family_c(runs, b.assign(outcome="undecided"))["outcome"]
    assert set(same) == {"none: transform-constant is not better than none"}


@pytest.mark.parametrize(
    ("outcomes", "cells", "said"),
    [
        (["equivalent"] * 12, 12, "holds"),
        (["equivalent"] * 11 + ["undecided"], 12, "undecided"),
        (["equivalent"] * 11 + ["different"], 12, "fails"),
        (["equivalent"] * 8, 8, "undecided"),
    ],
)
def test_the_verdict(outcomes: list[str], cells: int, said: str) -> None:
    feedbacks = [verdict.JUDGED[number % 2] for number in range(cells)]
    table = pd.DataFrame({"feedback": [*feedbacks, "random"], "outcome": [*outcomes, "different"]})
    assert verdict.verdict(table) == said


@pytest.mark.parametrize(
    ("plain", "driven", "said"),
    [
        ([0.5, 0.9, 50, 50], [5, 9, 50, 50], "holds"),
        ([0.5, 0.9, 50, 50], [5, 8.9, 50, 50], "undecided"),
        ([0.5, 1.1, 50, 50], [50, 50, 50, 50], "undecided"),
        ([11, 20, 30, 40], [11, 20, 30, 40], "contradicted"),
        ([9, 20, 30, 40], [9, 20, 30, 40], "undecided"),
    ],
)
def test_vanishing(plain: list[float], driven: list[float], said: str) -> None:
    assert verdict.vanishing(pd.DataFrame({"plain": plain, "driven": driven})) == said


def test_a_diverged_run_is_held_at_its_last_value(tmp_path: Path) -> None:
    """100 episodes of 50 steps, then episodes of 10: of them, 3 end before the run was last seen to be finite."""
    lengths = np.array([50] * 100 + [10] * 50)
    steps, end = lengths.cumsum().astype(float), int(lengths.sum())
    plain = packed.summary(steps, lengths.astype(float), end, None)
    means = np.concatenate((np.full(100, 50.0), 50 - 0.4 * np.arange(1, 51)))[:-1]  # of 100, after each episode
    latest = np.concatenate(([50.0], means))
    assert plain["area"] == plain["recorded"] == pytest.approx(np.average(latest, weights=lengths))
    held = packed.summary(steps, lengths.astype(float), end, 5035)
    later = np.minimum(np.arange(50), 3)
    expected = (5000 * 50.0 + 10 * (50 - 0.4 * later).sum()) / end
    assert held["area"] == pytest.approx(expected, rel=1e-3)
    assert held["recorded"] == plain["area"]
    finite = np.array([True, True, False, False])
    points = np.array([1000, 2000, 3000, 4000])
    assert [packed.held_from(part, points) for part in (finite, ~finite, finite | True)] == [2000, 128, 4000]


def test_what_is_packed_is_what_ran(tmp_path: Path) -> None:
    """Two runs with four measurements of two layers, of which the second diverges after the first."""
    measures = np.ones((20, 8, 2, 3), np.float32)
    measures[:, 0, 0] = [2, 3, 4]
    measures[1:, :, 1] = np.nan
    measures[0, 0, 1] = [1, 3, 8]
    measures[:, 1] = [3, 1, 1.5]
    returns = np.array([20] * 20 + [20] * 20, np.int16)
    about = {"condition": "transform", "depth": 2, "steps": 400, "device": "cpu", "names": list(NAMES)}
    arrays: dict[str, NDArray[np.generic]] = {
        "about": np.array(json.dumps(about)), "optimizer": np.array(["sgd", "adam"]), "seed": np.array([0, 0]),
        "rate": np.array([0.1, 0.2]), "finite": np.array([True, False]), "counts": np.array([20, 20]),
        "env_step": np.tile(np.arange(20, 401, 20), 2), "returns": returns, "points": np.arange(130, 330, 10),
        "measures": measures,
    }  # fmt: skip
    np.savez(tmp_path / "study-2-transform.npz", **arrays)  # type: ignore[arg-type]
    (tmp_path / "plan.md").write_text("rules\n## Changes\n")
    assert packed.pack(tmp_path, tmp_path / "runs.parquet", tmp_path / "plan.md") == 2
    rows, _ = packed.unpacked(tmp_path / "runs.parquet")
    runs = rows[rows["phase"] == "study"]
    assert runs["condition"].tolist() == ["transform-constant"] * 2
    assert runs["area"].tolist() == [20, 20]
    assert runs["held"].iloc[1] == 130
    np.testing.assert_allclose(runs["plain"].iloc[0], [0.5] * 4)
    np.testing.assert_allclose(runs["driven"].iloc[0], [1.0] * 4)
    np.testing.assert_allclose(runs["plain"].iloc[1], [0.125, np.nan, np.nan, np.nan])
    layers = rows[(rows["phase"] == "layers") & (rows["optimizer"] == "sgd") & (rows["measure"] == "gradient_norm")]
    assert [list(median) for median in layers["median"]] == [[2, 3, 4]] * 4
    data = verdict.load(tmp_path / "runs.parquet")
    assert len(data.study) == 2
    (tmp_path / "plan.md").write_text("rules\n## Changes\nlater\n")
    verdict.load(tmp_path / "runs.parquet")
    (tmp_path / "plan.md").write_text("other rules\n## Changes\n")
    with pytest.raises(ValueError, match="not the plan"):
        verdict.load(tmp_path / "runs.parquet")


NAMES = ("gradient_norm", "gradient_ratio", "gradient_cosine", "step_ratio", "step_cosine", "least", "largest", "dead")


def test_areas_agree_with_the_curves_that_are_packed() -> None:
    study = verdict.load(EDL / "dissection.parquet").study
    curves = np.stack(study["curve"].to_list()).mean(axis=1)
    np.testing.assert_allclose(study["area"], curves, atol=4)
    assert np.abs(study["area"] - curves).mean() < 1.6
