"""Reports: the numbers agree with episodes.csv by other code, the page stands alone, partial data is named."""

import base64
import csv
import json
import math
import re
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coop.common.errors import RunError, UsageError
from coop.common.numbers import running_mean
from coop.common.settings.tables import sealed_toml
from coop.learner.summary import summarise
from coop.lockstep.lockstep import Lockstep
from coop.records.run_directory import RunDirectory
from coop.studies.report import cli
from coop.studies.report.figures import NETWORKS, figures
from coop.studies.report.intervals import (
    drawn_seeds,
    improvement,
    iqm,
    iqm_by_task,
    iqm_overall,
    over_seeds,
    profiles,
    tail,
)
from coop.studies.report.measures import breaking_point
from coop.studies.report.results import breaking_table, table_1
from coop.studies.report.study import load_study
from coop.studies.report.writer import write_report
from coop.studies.sweep.grid import load_grid

pytestmark = pytest.mark.timeout(300)  # eight small runs come before the first test
GRID = """
title = "Small <and> smaller"
methods = ["dqn", "edql", "coop"]
seeds = [0, 1]
fixed.total_steps = 2000
fixed.network.hidden = [16]
fixed.learner.batch_size = 16
fixed.replay.learning_starts = 50
fixed.replay.ratio = 0.25
vary.replay.capacity = [60, 300]
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep's folder with every run of dqn and coop, one of edql torn and the others not begun."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "sweep.toml").write_text(sealed_toml(GRID))
    for cell in load_grid(str(folder / "sweep.toml")).cells:
        if cell.config.method != "edql":
            run = Lockstep(cell.config)
            with RunDirectory(folder / cell.name, cell.config) as directory:
                for _ in range(cell.config.total_steps):
                    for effects in run.play():
                        directory.record(effects.episodes, effects.metrics)
                directory.conclude(summarise(run.trainer, "complete", time.monotonic(), run.step), "a run")
            run.env.close()
    torn = folder / "edql-capacity=60-seed=0"
    torn.mkdir()
    (torn / "episodes.csv").touch()
    return folder


@pytest.fixture(scope="module")
def report(study: Path) -> Path:
    write_report(study, study / "report")
    return study / "report"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def returns(run: Path) -> list[float]:
    return [float(row["return"]) for row in rows(run / "episodes.csv")]


@pytest.mark.parametrize("name", ["dqn-capacity=60-seed=1", "coop-capacity=300-seed=0"])
def test_a_run_recomputed_from_its_episodes(name: str, study: Path, report: Path) -> None:
    (row,) = (row for row in rows(report / "table_runs.csv") if row["run"] == name)
    last = returns(study / name)[-100:]
    assert len(last) == 100 < len(returns(study / name))
    assert float(row["mean"]) == pytest.approx(sum(last) / len(last), rel=1e-9)
    assert float(row["sd"]) == pytest.approx(statistics.pstdev(last), rel=1e-9)
    assert int(row["episodes"]) == len(returns(study / name))
    lines = [json.loads(line) for line in (study / name / "metrics.jsonl").read_text().splitlines()]
    late = [line["sample_age_mean"] for line in lines if line["env_step"] >= lines[-1]["env_step"] / 2]
    assert float(row["sample_age_mean"]) == pytest.approx(statistics.fmean(late))
    assert float(row["evicted_unsampled"]) == pytest.approx(lines[-1]["evicted_unsampled"])
    late = [line for line in lines if line["env_step"] >= lines[-1]["env_step"] / 2]
    for column in ("archive_td_error", "archive_drift", "policy_churn", "dormant_share", "effective_rank"):
        assert float(row[column]) == pytest.approx(statistics.fmean(line[column] for line in late if column in line))
    assert float(row["terminal_share"]) == pytest.approx(statistics.fmean(line["terminal_share"] for line in late))
    shares = [line["q_abs_mean"] / line["q_bound"] for line in late]
    assert float(row["q_share"]) == pytest.approx(statistics.fmean(shares))


def test_settings_and_breaking_points_recomputed(study: Path, report: Path) -> None:
    means = {
        (method, capacity): [
            statistics.fmean(returns(study / f"{method}-capacity={capacity}-seed={seed}")[-100:]) for seed in (0, 1)
        ]
        for method in ("dqn", "coop")
        for capacity in (60, 300)
    }
    for row in rows(report / "table_settings.csv"):
        both = means[row["method"], int(row["replay.capacity"])]
        assert float(row["mean"]) == float(row["IQM"]) == pytest.approx(statistics.fmean(both))
        assert float(row["sd over runs"]) == pytest.approx(statistics.stdev(both))
        assert [float(row["IQM low"]), float(row["IQM high"])] == pytest.approx(sorted(both))
        assert (row["runs"], row["seeds"]) == ("2", "0,1")
    for row in rows(report / "table_breaking_points.csv"):
        small, large = (statistics.fmean(means[row["method"], capacity]) for capacity in (60, 300))
        assert int(row["breaking point"]) == (60 if small >= 0.95 * large else 300)
        assert float(row["return there"]) == pytest.approx(large)
    (better,) = rows(report / "table_improvement.csv")
    wins = [x > y for c in (60, 300) for x in means["coop", c] for y in means["dqn", c]]
    assert (better["x"], better["y"], float(better["P(x > y)"])) == ("coop", "dqn", statistics.fmean(wins))
    paper = {row["method"]: row for row in rows(report / "table_table1.csv")}
    assert paper["dqn"]["paper mean"] == "193.6"
    assert float(paper["coop"]["mean"]) == pytest.approx(statistics.fmean(means["coop", 300]))
    assert list(paper) == ["dqn", "coop"], "no row without runs"


def test_curves_recomputed(study: Path, report: Path) -> None:
    both = [study / f"coop-capacity=60-seed={seed}" for seed in (0, 1)]
    at = {
        name: {int(float(row["x"])): float(row["y"]) for row in rows(report / f"{name}.csv") if "60" in row["panel"]
               and row["line"] == "coop"}
        for name in ("returns_episodes", "returns_steps", "q_gap")
    }  # fmt: skip
    number = max(at["returns_episodes"])
    assert number == min(len(returns(run)) for run in both)
    assert at["returns_episodes"][number] == pytest.approx(
        statistics.fmean(statistics.fmean(returns(run)[:number][-100:]) for run in both)
    )
    step, last = max(at["returns_steps"]), []
    for run in both:
        until = [float(row["return"]) for row in rows(run / "episodes.csv") if int(row["env_step"]) <= step]
        last.append(statistics.fmean(until[-100:]))
    assert at["returns_steps"][step] == pytest.approx(statistics.fmean(last))
    gaps = []
    for run in both:
        when = int(rows(run / "episodes.csv")[number - 1]["env_step"])
        lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        gaps.append([line["q_gap"] for line in lines if line["env_step"] <= when][-1])
    assert at["q_gap"][number] == pytest.approx(statistics.fmean(gaps))


def test_curves_and_points_of_the_diagnostics(study: Path, report: Path) -> None:
    runs = [study / f"coop-capacity=300-seed={seed}" for seed in (0, 1)]
    lines = [[json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()] for run in runs]
    points = [row for row in rows(report / "networks.csv") if row["line"] == "coop"]
    ends = [float(row["y"]) for row in points if row["panel"] == "effective rank of the last hidden layer"]
    assert ends[-1] == pytest.approx(statistics.fmean(each[-1]["effective_rank"] for each in lines))
    assert {row["panel"] for row in rows(report / "networks.csv")} == set(NETWORKS.values())
    at = [row for row in rows(report / "networks_buffers.csv") if (row["line"], row["x"]) == ("coop", "300")]
    means = [
        statistics.fmean(line["terminal_share"] for line in each if line["env_step"] >= each[-1]["env_step"] / 2)
        for each in lines
    ]
    assert [float(at[-1][name]) for name in ("y", "low", "high")] == pytest.approx(
        [statistics.fmean(means), min(means), max(means)]
    )


def test_the_page_stands_alone_and_comes_out_the_same(study: Path, report: Path, tmp_path: Path) -> None:
    text = (report / "index.html").read_text()
    pictures = sorted(report.glob("*.png"))
    assert {path.stem for path in pictures} == {
        *("returns_episodes", "returns_steps", "exploration", "q_gap", "buffers", "diagnostics", "final_returns"),
        *("iqm", "improvement", "profiles", "networks", "networks_buffers"),
    }
    for path in pictures:
        assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF-")
        assert f'src="data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"' in text
    assert not re.search(r"(src|href)=(?!\"data:)|https?:", text)
    assert "<h1>Small &lt;and&gt; smaller</h1>" in text
    assert "edql-capacity=60-seed=0: begun, not finished" in text
    assert text.count(": not begun") == 3
    assert all("seeds" in figure.counts for figure in figures(load_study(study))[0])
    write_report(study, tmp_path / "again")
    for path in report.iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes(), path.name


def test_one_run_alone(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(study / "coop-capacity=300-seed=1", tmp_path / "runs" / "one")
    monkeypatch.setattr("sys.argv", ["coop-report", str(tmp_path / "runs"), "--out", str(tmp_path / "out")])
    cli.main()
    text = (tmp_path / "out" / "index.html").read_text()
    assert "<p>1 of 1 runs finished: coop on CartPole-v0, seeds 1. Eviction: reservoir. Settings with 1 run: " in text
    assert "Return against buffer size, breaking points: replay.capacity is the same in all finished runs" in text
    assert re.findall("<h2>(.*?)</h2>", text)[0] == "Return of the last 100 episodes"
    assert "1 row<" in text
    assert not re.search(r"\b1 (rows|figures)\b", text)
    assert not (tmp_path / "out" / "buffers.png").exists()
    assert rows(tmp_path / "out" / "table_settings.csv")[0]["IQM low"] == ""


def test_without_the_largest_capacity_there_is_no_breaking_point(study: Path, tmp_path: Path) -> None:
    shutil.copytree(study, tmp_path / "runs")
    for gone in (tmp_path / "runs").glob("coop-capacity=300-*"):
        shutil.rmtree(gone)
    dqn, coop = breaking_table(load_study(tmp_path / "runs")).rows
    assert (dqn[0], type(dqn[1]), dqn[5]) == ("dqn", int, 300)
    assert coop == ["coop", None, None, None, None, 300, None, None]


def test_a_figure_that_can_t_be_written(study: Path, tmp_path: Path) -> None:
    shutil.copytree(study / "coop-capacity=300-seed=1", tmp_path / "runs" / "one")
    (tmp_path / "out" / "returns_steps.pdf").mkdir(parents=True)
    with pytest.raises(UsageError, match=r"--out .*: Is a directory"):
        write_report(tmp_path / "runs", tmp_path / "out")


def test_what_is_no_study(study: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no run"):
        write_report(tmp_path, tmp_path / "out")
    run = tmp_path / "runs" / "a"
    shutil.copytree(study / "dqn-capacity=60-seed=0", run)
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"--out .*Not a directory"):
        write_report(run.parent, tmp_path / "file" / "out")
    (run / "episodes.csv").write_text("episode,return\n1,x\n")
    with pytest.raises(RunError, match=r"episodes\.csv: has 19 bytes, and should have at least"):
        write_report(run.parent, tmp_path / "out")
    (run / "summary.json").unlink()
    with pytest.raises(RunError, match="none of its 1 runs is finished"):
        write_report(run.parent, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("means", "capacity", "gaps"),
    [
        ([10, 96, 97, 100], 100, False),
        ([95, 96, 97, 100], 50, False),
        ([96, 10, 97, 100], 50, True),
        ([10, 20, 30, 100], 5000, False),
        ([-106, -105, -100, -100], 100, False),
    ],
)
def test_breaking_points(means: list[float], capacity: int, gaps: bool) -> None:
    found = breaking_point(np.array([50, 100, 500, 5000]), [np.array([mean, mean], np.float64) for mean in means])
    assert found == (capacity, capacity, capacity, gaps)


def test_a_breaking_point_has_an_interval() -> None:
    found = breaking_point(np.array([50, 500]), [np.array([90.0, 100.0, 100.0, 99.0]), np.array([100.0, 101.0])])
    assert found == (50, 50, 500, False)


def rliable() -> tuple[Any, Any]:
    """Its `library` and `metrics`, which take two seconds: every worker collects this file, one runs it."""
    from rliable import library, metrics  # noqa: PLC0415

    return library, metrics


def test_statistics_are_rliables() -> None:
    library, metrics = rliable()
    generator = np.random.default_rng(3)
    x, y = generator.integers(0, 9, (7, 3)).astype(np.float64), generator.integers(0, 9, (5, 3)).astype(np.float64)
    assert iqm_overall(x).value == pytest.approx(metrics.aggregate_iqm(x))
    assert iqm_by_task(x).value == pytest.approx([metrics.aggregate_iqm(task) for task in x.T])
    assert improvement(x, y).value == pytest.approx(metrics.probability_of_improvement(x, y))
    levels = np.arange(-1.0, 10.0)
    shares, _ = library.create_performance_profile({"x": x, "y": y}, levels, reps=10)
    for name, ours in profiles({"x": x, "y": y}, levels).items():
        np.testing.assert_allclose(ours.value, shares[name], rtol=1e-12)


def test_bootstrap_intervals_are_as_wide_as_those_of_t() -> None:
    """Of means: their bootstrap distribution is nearly normal from ten seeds on, and narrower by sqrt((n - 1) / n)."""
    from scipy import stats  # noqa: PLC0415

    for seeds in (10, 20, 100):
        sample = np.random.default_rng(seeds).normal(size=seeds)
        drawn = sample[drawn_seeds(seeds, np.random.default_rng(1))].mean(axis=1)
        low, high = np.quantile(drawn, [tail(seeds), 1 - tail(seeds)])
        wide = 2 * stats.t.ppf(0.975, seeds - 1) * stats.sem(sample)
        assert high - low == pytest.approx(wide, rel=0.06)
        if seeds < 100:
            assert np.diff(np.percentile(drawn, [2.5, 97.5])) < 0.96 * wide


@pytest.mark.parametrize("seeds", [5, 10])
@pytest.mark.parametrize("cap", [math.inf, 1.0])
def test_intervals_hold_what_they_estimate(seeds: int, cap: float) -> None:
    """In 95 of 100 samples about: of a normal distribution, and of one with a cap that a sixth of it reaches."""
    population = np.random.default_rng(0).normal(size=200_000).clip(max=cap)
    samples = np.random.default_rng(1).choice(population, (400, seeds))
    means = [over_seeds(sample) for sample in samples]
    found = iqm_by_task(samples.T)
    held = np.mean([each.low <= population.mean() <= each.high for each in means])
    middle = iqm(population[:, None])
    assert 0.92 <= held <= 0.98
    assert 0.92 <= ((found.low <= middle) & (middle <= found.high)).mean() <= 0.99
    assert (found.high <= cap).all()
    drawn = samples[:, drawn_seeds(seeds, np.random.default_rng(2))[:500]].mean(axis=2)
    low, high = np.percentile(drawn, [2.5, 97.5], axis=1)
    assert ((low <= population.mean()) & (population.mean() <= high)).mean() < 0.92  # what plain percentiles hold


def test_settings_of_one_seed_are_no_independent_runs() -> None:
    """Twelve settings that all return what the seed alone decides tell no more than one of them does."""
    one, other = (np.random.default_rng(seed).normal(size=(5, 1)) for seed in (1, 2))
    alone, twelve = (iqm_overall(np.tile(one, (1, settings))) for settings in (1, 12))
    assert twelve.high - twelve.low >= 0.9 * (alone.high - alone.low)
    for better in (improvement, lambda x, y: profiles({"x": x - y}, np.zeros(1))["x"]):
        once, often = (better(np.tile(one, (1, n)), np.tile(other, (1, n))) for n in (1, 12))
        np.testing.assert_allclose(often, once)


def test_the_running_mean_takes_a_hundred_episodes() -> None:
    mean = running_mean(np.arange(250.0))
    assert (mean[0], mean[99], mean[249]) == (0.0, 49.5, 199.5)


@pytest.mark.parametrize(
    ("env", "coop"),
    [("CartPole-v0", 200), ("space-invaders", 1144), ("ALE/SpaceInvaders-v5", 1144), ("Pong-v5", 19.15), ("x", None)],
)
def test_the_papers_column(env: str, coop: float | None) -> None:
    assert table_1(env).get("coop", (None,))[0] == coop
