"""Searches by Optuna over real runs, and the tables of all runs of a folder."""

import runpy
import sys
import time
from pathlib import Path
from typing import Any

import optuna
import pytest
from commands import Command

import coop
from coop.studies.report.packing import pack

pytestmark = [
    pytest.mark.timeout(500),
    pytest.mark.usefixtures("quick_children"),
    pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning"),
]
EXAMPLE = Path(__file__).parents[1] / "examples" / "tune_buffer.py"
FIXED = {"total_steps": 300, "replay": {"capacity": 100, "learning_starts": 50}}
RATES = {"learner": {"learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}}
STATE = optuna.trial.TrialState


def test_the_example_searches_and_its_runs_are_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len([line for line in EXAMPLE.read_text().splitlines() if line.strip()]) <= 17
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["tune_buffer.py", "300"])
    study = runpy.run_path(str(EXAMPLE))["study"]
    assert [trial.state.is_finished() for trial in study.trials] == [True] * 4
    best = study.best_trial
    assert best.user_attrs["seeds"] == [0, 1]
    folders = [tmp_path / "runs" / "tuned" / f"trial-{best.number:04}-seed={seed}" for seed in (0, 1)]
    runs = [coop.load(folder) for folder in folders]
    assert study.best_value == pytest.approx(sum(run.episodes["return"].tail(100).mean() for run in runs) / 2)
    for run in runs:
        assert run.config.learner.learning_rate == best.params["learner.learning_rate"]
        assert run.config.learner.batch_size == best.user_attrs["settings"]["learner.batch_size"]
    assert {run.config.seed for run in runs} == {0, 1}
    frames = coop.load_sweep(tmp_path / "runs" / "tuned")
    one = frames.episodes[frames.episodes["run"] == folders[0].name]
    assert one["return"].tolist() == runs[0].episodes["return"].tolist()
    assert set(one["learner.learning_rate"]) == {best.params["learner.learning_rate"]}
    assert {"method", "seed", "learner.batch_size", "loss", "update"} <= set(frames.metrics)
    pack(tmp_path / "runs" / "tuned", tmp_path / "packed.parquet")
    packed = coop.load_sweep(tmp_path / "packed.parquet")
    for name in ("run", "seed", "learner.learning_rate", "return", "env_step"):
        assert packed.episodes[name].tolist() == frames.episodes[name].tolist()
    assert packed.metrics["loss"].tolist() == frames.metrics["loss"].tolist()


def test_bad_trials_fail_and_bad_grids_are_refused(tmp_path: Path) -> None:
    # The first value is fine, the second diverges, and the third is refused.
    vary = {"learner": {"learning_rate": [1e-3, 1e30, -1.0]}}
    sampler = optuna.samplers.GridSampler({"learner.learning_rate": [1e-3, 1e30, -1.0]}, seed=0)
    study = coop.tune({"fixed": FIXED, "vary": vary}, tmp_path / "a", trials=3, workers=2, sampler=sampler)
    by_rate = {trial.params["learner.learning_rate"]: trial for trial in study.trials}
    assert {rate: trial.state for rate, trial in by_rate.items()} == {
        1e-3: STATE.COMPLETE, 1e30: STATE.FAIL, -1.0: STATE.FAIL,
    }  # fmt: skip
    assert by_rate[1e30].user_attrs["why"].startswith("diverged")
    assert "learner.learning_rate = -1.0" in by_rate[-1.0].user_attrs["why"]
    for wrong, text in (
        ({"vary": {"learner": {"rate": [1]}}}, r"learner\.rate"),
        ({"vary": {"learner": {"learning_rate": {"low": 1, "high": 0.1}}}}, r"vary\.learner\.learning_rate"),
        ({"vary": {"learner": {"learning_rate": 1}}}, "must be a list"),
        ({"methdos": ["dqn"]}, "methdos"),
    ):
        with pytest.raises(coop.UsageError, match=text):
            coop.tune(wrong, tmp_path / "b")
    with pytest.raises(coop.UsageError, match="does not exist"):
        coop.load_sweep(tmp_path / "b")


class Second(optuna.pruners.BasePruner):
    """Prunes trial 1 at its first report."""

    def prune(self, study: optuna.Study, trial: Any) -> bool:
        return bool(trial.number == 1)


def test_a_pruned_trial_s_run_is_stopped(tmp_path: Path) -> None:
    grid = {"fixed": {**FIXED, "total_steps": 1_000}, "vary": RATES}
    study = coop.tune(grid, tmp_path, trials=2, workers=1, pruner=Second())
    assert [trial.state for trial in study.trials] == [STATE.COMPLETE, STATE.PRUNED]
    summary = coop.load(tmp_path / "trial-0001").summary
    assert summary is not None
    assert (summary["exit"], summary["env_steps"] < 1_000) == ("interrupted", True)
    assert max(study.trials[0].intermediate_values) <= 20


def test_a_search_that_was_killed_goes_on(tmp_path: Path) -> None:
    grid = {"fixed": {**FIXED, "total_steps": 2_000, "checkpoint_every": 100}, "vary": RATES}
    script = tmp_path / "search.py"
    script.write_text(f"import coop; coop.tune({grid!r}, {str(tmp_path)!r}, trials=1, workers=1)")
    record = tmp_path / "trial-0000" / "metrics.jsonl"
    with Command(script) as first:  # which is killed at its end
        while not (record.exists() and record.stat().st_size):
            assert first.returncode is None
            time.sleep(0.1)
    while coop.load(tmp_path / "trial-0000").summary is None:  # its run saves its state and ends
        time.sleep(0.1)
    study = coop.tune(grid, tmp_path, trials=1, workers=1)
    assert [trial.state for trial in study.trials] == [STATE.COMPLETE]
    summary = coop.load(tmp_path / "trial-0000").summary
    assert summary is not None
    assert (summary["exit"], summary["env_steps"]) == ("complete", 2_000)
