"""Measures of the course of learning and of differences between methods, against numbers derived by hand."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from coop.common.errors import RunError
from coop.common.settings.tables import resolve
from coop.studies.report.comparisons import common_breaking_table, interaction_table, learning_table, sizes_table
from coop.studies.report.figures import figures
from coop.studies.report.intervals import over_seeds
from coop.studies.report.learning import area, course, end_of_running_mean, reward_threshold
from coop.studies.report.page import page
from coop.studies.report.results import runs_table, settings_table, tables
from coop.studies.report.study import Run, load_study

METHODS, SEEDS, CAPACITIES = ("dqn", "coop"), (0, 1, 2), (500, 600, 5000)


def run(returns: list[float], ends: list[float]) -> Run:
    zeros = np.zeros(len(returns))
    return Run("a", resolve({}), np.array(ends, np.float64), np.array(returns, np.float64), zeros, zeros, zeros, {})


def test_the_course_of_a_run_that_collapses_once() -> None:
    # Means of 20 episodes: 200 at step 200, 195 at 210, 145 at 310, 100 at 400, 195 at 590, 200 at 600.
    returns = [200.0] * 20 + [100.0] * 20 + [200.0] * 20
    measured = course(run(returns, [10.0 * (n + 1) for n in range(60)]), 195.0)
    assert measured == (200.0, pytest.approx(30 / 400), 1, 110.0 + 10.0)


@pytest.mark.parametrize(
    ("returns", "threshold", "expected"),
    [
        ([194.9] * 30, 195.0, (math.inf, math.nan, 0, 0.0)),
        ([200.0] * 10, 195.0, (math.inf, math.nan, 0, 0.0)),  # too short for a mean of 20
        ([200.0] * 20, 195.0, (20.0, math.nan, 0, 0.0)),
        ([200.0] * 30 + [150.0] * 30, 195.0, (20.0, 13 / 40, 0, 40.0)),  # down to 150, not below
        ([-100.0] * 20 + [-124.0] * 20 + [-90.0] * 5, -100.0, (20.0, 1 / 25, 1, 20.0)),  # below -123.08
    ],
)
def test_courses(returns: list[float], threshold: float, expected: tuple[float, ...]) -> None:
    measured = course(run(returns, [float(n + 1) for n in range(len(returns))]), threshold)
    assert measured == pytest.approx(expected, nan_ok=True)


def test_area_and_running_mean() -> None:
    assert area(run([10, 30, 50], [10, 40, 100])) == pytest.approx((10 * 10 + 30 * 10 + 60 * 20) / 100)
    ends = end_of_running_mean(run([0.0] * 100 + [100.0] * 100, [float(n) for n in range(1, 201)]))
    assert (len(ends), ends[0], ends[-1]) == (100, 1.0, 100.0)


def test_over_seeds() -> None:
    assert over_seeds([3.0]) == pytest.approx((3.0, math.nan, math.nan), nan_ok=True)
    assert over_seeds([2.0, 2.0, 2.0]) == (2.0, 2.0, 2.0)
    # 4.3027 and 2.2622: the quantiles of t in printed tables.
    assert over_seeds([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2 - 4.3027 / 3**0.5, 2 + 4.3027 / 3**0.5), abs=1e-4)
    ten = [float(n) for n in range(10)]
    assert over_seeds(ten) == pytest.approx((4.5, 4.5 - 2.2622 * 0.957427, 4.5 + 2.2622 * 0.957427), abs=1e-4)


def test_thresholds_are_gymnasiums() -> None:
    assert reward_threshold("CartPole-v0") == 195.0
    assert reward_threshold("no/Such-v0") is None


def score_of(method: str, seed: int, capacity: int) -> float:
    if method == "dqn":
        return 100.0 + seed
    return {500: 50.0, 600: 70.0, 5000: 200.0}[capacity] + 3 * seed


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_runs(tmp_path)


def write_runs(tmp_path: Path) -> Path:
    """Three capacities, two methods, three seeds, each run with one return throughout; one more run has diverged."""
    for method in METHODS:
        for seed in SEEDS:
            for capacity in CAPACITIES:
                value = score_of(method, seed, capacity)
                lines = "".join(f"{n},{20 * (n + 1)},{value},0.1,{n},1\n" for n in range(30))
                write(tmp_path / f"{method}-{capacity}-{seed}", method, seed, capacity, "complete", lines)
    write(
        tmp_path / "dqn-500-9", "dqn", 9, 500, "diverged: TD errors are not finite at update 2", "0,9,9,nan,nan,nan\n"
    )
    return tmp_path


def test_panels_share_an_axis_where_returns_have_one_scale(folder: Path) -> None:
    one = load_study(folder)
    for path in list(folder.iterdir()):
        other = folder / f"other-{path.name}"
        shutil.copytree(path, other)
        with (other / "config.toml").open("a") as config:
            config.write('env.id = "Acrobot-v1"\n')
    for study, shared in ((one, True), (load_study(folder), False)):
        drawn = {figure.name: figure for figure in figures(study)[0]}
        assert (drawn["buffers"].same_y, drawn["returns_steps"].same_y, "iqm" in drawn) == (shared, shared, shared)


def write(path: Path, method: str, seed: int, capacity: int, outcome: str, lines: str) -> None:
    path.mkdir()
    (path / "config.toml").write_text(f'method = "{method}"\nseed = {seed}\nreplay.capacity = {capacity}\n')
    (path / "summary.json").write_text(json.dumps({"exit": outcome}))
    (path / "episodes.csv").write_text(f"episode,env_step,return,s,q1_mean,q2_mean\n{lines}")
    (path / "metrics.jsonl").touch()


def test_size_and_method_by_hand(folder: Path) -> None:
    study = load_study(folder)
    assert sizes_table(study).rows[:2] == [
        ["all", "dqn", 101.0, 101.0, 0.0, 0.0, 0.0, 3],
        ["all", "coop", 63.0, 203.0, 140.0, 140.0, 140.0, 3],
    ]
    assert "small: capacities 500, 600; large: 5000." in sizes_table(study).note
    (row, *_) = interaction_table(study).rows
    # Coop's advantage by seed: 60 - 100, 63 - 101, 66 - 102 in small buffers, 100, 102, 104 in large ones.
    assert row == ["return of the last 100", "all", "coop", "dqn", -38.0, 102.0, -140.0, -140.0, -140.0, 3]
    dqn, coop = common_breaking_table(study).rows
    assert dqn == ["dqn", 203.0, None, None, None]
    assert coop == ["coop", 203.0, 5000, 5000, 5000]


def test_a_diverged_run_is_counted_and_averaged_nowhere(folder: Path) -> None:
    study = load_study(folder)
    rows = [dict(zip(learning_table(study).columns, row, strict=True)) for row in learning_table(study).rows]
    (row,) = (row for row in rows if row["method"] == "dqn" and row["replay.capacity"] == 500)
    assert (row["diverged"], row["runs"], row["area"], row["seeds"]) == (1, 3, pytest.approx(101.0), "0-2")
    (row, *_) = settings_table(study).rows
    assert row[:3] == ["dqn", 500, pytest.approx(101.0)]
    text = page(study, folder, tables(study), [], [])
    assert "<p>18 of 19 runs finished, 1 diverged: dqn, coop on CartPole-v0, seeds 0-2. Eviction: fifo. " in text
    assert "Settings with 3 runs: " in text
    assert "<li>dqn-500-9: diverged: TD errors are not finite at update 2</li>" in text
    assert "dqn-500-9" not in {row[0] for row in runs_table(study).rows}


def test_a_setting_whose_runs_have_all_diverged_is_listed(folder: Path) -> None:
    write(folder / "coop-900-0", "coop", 0, 900, "diverged: parameters are not finite at update 30", "")
    table = learning_table(load_study(folder))
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    (row,) = (row for row in rows if row["replay.capacity"] == 900)
    assert (row["method"], row["runs"], row["diverged"], row["area"]) == ("coop", 0, 1, None)


def test_where_all_have_diverged_there_is_no_report(tmp_path: Path) -> None:
    write(tmp_path / "a", "coop", 0, 500, "diverged: TD errors are not finite at update 2", "")
    with pytest.raises(RunError, match="none of its 1 runs is finished, 1 diverged"):
        load_study(tmp_path)
