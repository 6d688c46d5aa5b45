"""Searches by Optuna over real runs, and the tables of all runs of a folder."""

import importlib
import logging
import os
import runpy
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import optuna
import pytest
from commands import Command
from sqlalchemy import event

import coop
from coop.common.errors import RunError, UsageError
from coop.studies import tuning
from coop.studies.report.packing import pack
from coop.studies.space import Space

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


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    """What Optuna's log says."""
    monkeypatch.setattr(logging.getLogger("optuna"), "propagate", True)
    return caplog


def test_bad_trials_fail_and_bad_grids_are_refused(tmp_path: Path, said: pytest.LogCaptureFixture) -> None:
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
    for rate, ended in (
        (1e-3, f"finished with value {study.best_value:g}"),
        (1e30, "failed: diverged"),
        (-1.0, "failed"),
    ):
        assert f"Trial {by_rate[rate].number} {ended}" in said.text
    for wrong, text in (
        ({"vary": {"learner": {"rate": [1]}}}, r"learner\.rate"),
        ({"vary": {"learner": {"learning_rate": {"low": 1, "high": 0.1}}}}, r"vary\.learner\.learning_rate"),
        ({"vary": {"learner": {"learning_rate": 1}}}, "must be a list"),
        ({"methdos": ["dqn"]}, "methdos"),
        ({"vary": {"learner": {"batch_size": [WRONG]}}}, "grid: .*object"),
    ):
        with pytest.raises(coop.UsageError, match=text):
            coop.tune(wrong, tmp_path / "b")
    with pytest.raises(coop.UsageError, match="does not exist"):
        coop.load_sweep(tmp_path / "b")


WRONG = object()
REFUSED: Any = {"vary": {"learner": {"learning_rate": [1e-3, -1.0]}}, "fixed": FIXED}  # by each of its trials


def tune_none(folder: Path) -> optuna.Study:
    sampler = optuna.samplers.PartialFixedSampler({"learner.learning_rate": -1.0}, optuna.samplers.RandomSampler(0))
    return coop.tune(REFUSED, folder, trials=1, workers=1, sampler=sampler)


@pytest.mark.parametrize("name", ["a?mode=memory", "a#b%20c", "two\nlines \N{SNOWMAN}"])
def test_a_search_s_storage_lies_in_its_folder(name: str, tmp_path: Path) -> None:
    assert [trial.state for trial in tune_none(tmp_path / name).trials] == [STATE.FAIL]
    assert len(tune_none(tmp_path / name).trials) == 1, "the same search"
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name / "optuna.db").is_file()


def test_storages_that_are_none_are_refused_in_a_line(tmp_path: Path) -> None:
    folder, file = tmp_path / "search", tmp_path / "search" / "optuna.db"
    folder.mkdir()
    file.write_bytes(b"of something else" * 999)
    with pytest.raises(RunError, match=r"^storage .*optuna.db: DatabaseError: file is not a database$"):
        tune_none(folder)
    assert file.read_bytes() == b"of something else" * 999
    file.unlink()
    file.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match=r"optuna\.db: a link, to "):
        tune_none(folder)
    assert not (tmp_path / "elsewhere").exists()
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(UsageError, match=r"optuna\.db: neither a file nor a folder"):
        tune_none(folder)
    file.unlink()
    file.write_bytes(b"")
    with pytest.raises(UsageError, match=r"optuna\.db: File exists$|Not a directory$"):
        tune_none(file)
    with pytest.raises(RunError, match=r"nowhere/mine\.db: OperationalError: unable to open database file$"):
        coop.tune(REFUSED, folder, storage=f"sqlite:///{tmp_path}/nowhere/mine.db")


def test_a_search_goes_on_with_the_same_settings_alone(tmp_path: Path) -> None:
    tune_none(tmp_path / "a")
    for changed, words in (
        ({"fixed": {**FIXED, "total_steps": 320}}, "fixed.total_steps = 320: the search 'a' has 300; give another"),
        ({"methods": ["dqn"]}, r"methods = \['dqn'\]: the search 'a' has \['coop'\]"),
        ({"seeds": [0, 1]}, r"seeds = \[0, 1\]: the search 'a' has \[0\]"),
        (
            {"vary": {"learner": {"learning_rate": [1e-3]}}},
            r"vary.learner.learning_rate: .*trial 0 of the search 'a' had",
        ),
        ({"vary": RATES}, r"vary.learner.learning_rate: FloatDistribution.*; trial 0 .* had CategoricalDistribution"),
    ):
        with pytest.raises(UsageError, match=f"^{words}"):
            coop.tune({**REFUSED, **changed}, tmp_path / "a", trials=2, workers=1)
    assert len(coop.tune({**REFUSED, "title": "Why?"}, tmp_path / "a", trials=1).trials) == 1


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"sampler": 5}, "sampler = 5: must be a BaseSampler, or None"),
        ({"pruner": "median"}, "pruner = 'median': must be a BasePruner, or None"),
        ({"storage": 5}, "storage = 5: must be a str, or None"),
        ({"storage": "mysql://x"}, "storage mysql://x: ImportError: "),
        ({"storage": "redis://x"}, "storage redis://x: ValueError: "),
    ],
)
def test_what_is_no_sampler_pruner_or_storage(given: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"^{words}"):
        coop.tune(REFUSED, tmp_path / "a", **given)


def test_a_trial_s_folder_is_no_link_to_another_one(tmp_path: Path) -> None:
    (tmp_path / "search").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "search" / "trial-0000").symlink_to(tmp_path / "elsewhere")
    study = coop.tune({"fixed": FIXED, "vary": RATES}, tmp_path / "search", trials=1, workers=1)
    assert [trial.state for trial in study.trials] == [STATE.FAIL]
    assert "trial-0000: a link, to " in study.trials[0].user_attrs["why"]
    assert not list((tmp_path / "elsewhere").iterdir())


def test_what_a_grid_s_fields_are_chosen_from(tmp_path: Path) -> None:
    grid = tmp_path / "grid.toml"
    grid.write_text(
        """
        methods = ["dqn", "coop"]
        fixed.network.hidden = [8]
        [vary]
        network.hidden = [[8], [16, 16]]
        learner.batch_size = { low = 16, high = 64, step = 16 }
        learner.swap_every = { low = 1, high = 100, log = true }
        learner.learning_rate = { low = 1e-4, high = 1e-2, log = true }
        learner.gamma = { low = 0.5, high = 1 }
        replay.eviction = ["fifo", "reservoir"]
        [quick]
        fixed.total_steps = 7
        """
    )
    space = Space(grid)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    trial = study.ask()
    method, chosen = space.suggest(trial)
    assert trial.distributions == {
        "method": optuna.distributions.CategoricalDistribution(["dqn", "coop"]),
        "network.hidden": optuna.distributions.CategoricalDistribution(["[8]", "[16, 16]"]),
        "learner.batch_size": optuna.distributions.IntDistribution(16, 64, step=16),
        "learner.swap_every": optuna.distributions.IntDistribution(1, 100, log=True),
        "learner.learning_rate": optuna.distributions.FloatDistribution(1e-4, 1e-2, log=True),
        "learner.gamma": optuna.distributions.FloatDistribution(0.5, 1),
        "replay.eviction": optuna.distributions.CategoricalDistribution(["fifo", "reservoir"]),
    }
    assert chosen["network.hidden"] in ([8], [16, 16])
    (cell,) = space.cells("mine", method, chosen)
    assert (cell.name, cell.config.method, cell.config.total_steps) == ("mine", method, 50_000)
    assert list(cell.config.network.hidden) == chosen["network.hidden"]
    assert cell.config.learner.batch_size == chosen["learner.batch_size"]
    for wrong in (
        {"low": 0, "high": 1, "log": True}, {"low": 0.1, "high": 1, "log": True, "step": 0.1},
        {"low": 0, "high": True}, {"low": 2, "high": 1}, {"low": 0, "high": 1, "lgo": True}, {"low": 0}, [],
    ):  # fmt: skip
        with pytest.raises(coop.UsageError, match=r"^vary\.learner\.learning_rate = .*: must be"):
            Space({"vary": {"learner": {"learning_rate": wrong}}})
    with pytest.raises(coop.UsageError, match=r"nowhere\.toml: No such file"):
        coop.tune(tmp_path / "nowhere.toml", tmp_path)
    for counts in ({"trials": 0}, {"workers": 0}):
        with pytest.raises(coop.UsageError, match="must be a whole number from 1 on"):
            coop.tune(grid, tmp_path / "none", **counts)
    assert not (tmp_path / "none").exists()


def test_workers_run_at_once_and_two_processes_share_a_search(tmp_path: Path) -> None:
    """The second process waits for the trials of the first one; either may see first that one has ended."""
    grid = {"fixed": {**FIXED, "total_steps": 1_500, "network": {"hidden": [32]}}, "vary": RATES}
    url = f"sqlite:///{tmp_path / 'mine.db'}"
    call = f"coop.tune({grid!r}, {str(tmp_path / 'a')!r}, trials=2, workers=2, storage={url!r})"
    with subprocess.Popen([sys.executable, "-c", f"import coop; {call}"]) as other:
        try:
            while not (tmp_path / "a" / "trial-0001" / "episodes.csv").exists():
                assert other.poll() is None
                time.sleep(0.1)
            study = coop.tune(grid, tmp_path / "a", trials=2, workers=2, storage=url)
            assert other.wait(200) == 0
        finally:
            other.kill()
    assert {trial.state for trial in study.trials} == {STATE.COMPLETE}
    assert len(study.trials) >= 2, "more where both ask at the same moment"
    first, second = study.trials[:2]
    assert second.datetime_start < first.datetime_complete  # type: ignore[operator]
    assert not (tmp_path / "a" / "optuna.db").exists()
    for trial in study.trials:
        summary = coop.load(tmp_path / "a" / f"trial-{trial.number:04}").summary
        assert summary is not None
        assert trial.value == pytest.approx(summary["return_mean_100"])
        assert (summary["exit"], summary["env_steps"]) == ("complete", 1_500)


@pytest.mark.parametrize("url", [False, True])
def test_a_storage_that_another_process_makes_meanwhile(url: bool, tmp_path: Path) -> None:
    """Once it is seen which tables lack, and before they are made, another process makes them."""
    file = tmp_path / "optuna.db"
    tables = importlib.import_module("optuna.storages._rdb.models").BaseModel.metadata

    @event.listens_for(tables, "before_create", once=True)
    def another(*_: object, **__: object) -> None:
        made = "import optuna, sys; optuna.create_study(storage=sys.argv[1], study_name='mine', direction='maximize')"
        subprocess.run([sys.executable, "-c", made, f"sqlite:///{file}"], check=True)

    study = tuning._study(f"sqlite:///{file}" if url else file, "mine", None)
    assert study.study_name == "mine"
    with closing(sqlite3.connect(file)) as made:
        assert made.execute("SELECT study_name FROM studies").fetchall() == [("mine",)]


class Second(optuna.pruners.BasePruner):
    """Prunes trial 1 at its first report."""

    def prune(self, study: optuna.Study, trial: Any) -> bool:
        return bool(trial.number == 1)


def test_a_pruned_trial_s_run_is_stopped(tmp_path: Path, said: pytest.LogCaptureFixture) -> None:
    grid = {"fixed": {**FIXED, "total_steps": 1_000}, "vary": RATES}
    study = coop.tune(grid, tmp_path, trials=2, workers=1, pruner=Second())
    assert [trial.state for trial in study.trials] == [STATE.COMPLETE, STATE.PRUNED]
    assert "Trial 1 pruned; parameters: {'learner.learning_rate': " in said.text
    summary = coop.load(tmp_path / "trial-0001").summary
    assert summary is not None
    assert (summary["exit"], summary["env_steps"] < 1_000) == ("interrupted", True)
    told = study.trials[0].intermediate_values
    assert max(told) <= 20
    returns, steps = (coop.load(tmp_path / "trial-0000").episodes[name].tolist() for name in ("return", "env_step"))
    reached = {step * 20 // 1_000: at + 1 for at, step in reversed(list(enumerate(steps))) if step >= 50}
    assert told == {step: pytest.approx(sum(returns[:at]) / at) for step, at in reached.items()}, "of 100 at most"


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
