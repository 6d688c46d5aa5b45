"""Records: JSON that every reader takes, returns to the last digit, and TensorBoard's files of a resumed run."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from matplotlib.axes import Axes
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from coop.common.numbers import exact, strict_json
from coop.common.process.lifecycle import Stop
from coop.learner.summary import summarise
from coop.lockstep.lockstep import Lockstep
from coop.lockstep.run import LockstepRun
from coop.records.curve import draw_curve
from coop.records.resumption import Start
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config
from coop.records.summaries import SUMMARY, read_summary
from coop.studies.report.packed import PackedStudy
from coop.studies.report.packing import pack

EXACT = [1234567.89, -0.1, 9.0, 1e300, 0.1 + 0.2, 16777217.0, 123456789.0]


def not_json(name: str) -> None:
    raise AssertionError(f"{name} is no JSON")


@pytest.mark.parametrize("number", EXACT)
def test_the_text_of_a_number_reads_as_the_same(number: float) -> None:
    assert float(exact(number)) == number
    assert not exact(number).endswith(".0")


def test_numbers_that_are_not_finite_are_null() -> None:
    value = {"a": math.nan, "b": [1.5, -math.inf, {"c": math.inf}], "d": (None, "nan")}
    assert json.loads(strict_json(value), parse_constant=not_json) == {
        "a": None, "b": [1.5, None, {"c": None}], "d": [None, "nan"]
    }  # fmt: skip
    assert strict_json({"a": 0.1}) == json.dumps({"a": 0.1})


def test_a_summary_without_finite_returns_is_json(tmp_path: Path) -> None:
    run = Lockstep(base_config(["--method", "coop"]))
    with RunDirectory(tmp_path, run.config) as directory:
        summary = replace(summarise(run.trainer, "diverged", 0.0, 0), return_mean_100=math.nan, return_sd_100=math.inf)
        directory.conclude(summary, "a run")
    run.env.close()
    json.loads((tmp_path / SUMMARY).read_text(), parse_constant=not_json)
    assert read_summary(tmp_path)["return_mean_100"] is None


def returns(folder: Path) -> list[float]:
    with (folder / "episodes.csv").open() as file:
        return [float(row["return"]) for row in csv.DictReader(file)]


def test_a_packed_study_keeps_returns_exactly(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    study = tmp_path / "study"
    for number in range(2):
        (study / str(number)).mkdir(parents=True)
        (study / str(number) / "config.toml").write_text('method = "coop"\n')
        rows = (f"{n},{exact(value)},0.725354" for n, value in enumerate(EXACT[number:]))
        (study / str(number) / "episodes.csv").write_text("\n".join(["env_step,return,s", *rows, ""]))
    pack(study, tmp_path / "packed.parquet")
    packed = PackedStudy(tmp_path / "packed.parquet")
    for number in range(2):
        columns = packed.columns(str(number), "episodes.csv", ("return", "s"))
        assert columns == {"return": EXACT[number:], "s": [0.725354] * len(EXACT[number:])}


def test_tensorboard_is_cut_back_with_the_records(tmp_path: Path) -> None:
    """As after a kill -9 behind the newest checkpoint; the files of others in the folder stay as they are."""
    config = base_config(["--method", "coop"])
    replay_settings = replace(config.replay, learning_starts=50, capacity=200)
    config = replace(config, total_steps=700, checkpoint_every=300, replay=replay_settings)
    run, path = Lockstep(config), tmp_path / "run"
    with RunDirectory(path, config) as directory:
        while run.step < 600:
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
            if run.trainer.checkpoint_due():
                run.trainer.checkpoint_begun()
                run.save(directory)
    run.env.close()
    (mine,) = (path / "tb").iterdir()
    with mine.open("ab") as file:
        file.write(b"torn")
    theirs = path / "tb" / "events.out.tfevents.0000000001.elsewhere.1"
    theirs.write_bytes(b"not a run's")
    before = [each.step for each in EventAccumulator(str(mine)).Reload().Scalars("charts/episodic_return")]
    resumed = LockstepRun(config, path, "test", Start(resume=True))
    resumed.play(Stop())
    resumed.close()
    with (path / "episodes.csv").open() as file:
        ends = [int(row["env_step"]) for row in csv.DictReader(file)]
    rows = [json.loads(line)["env_step"] for line in (path / "metrics.jsonl").read_text().splitlines()]
    assert theirs.read_bytes() == b"not a run's"
    theirs.unlink()
    board = EventAccumulator(str(path / "tb"), {"histograms": 0}, purge_orphaned_data=False).Reload()
    assert [each.step for each in board.Scalars("charts/episodic_return")] == ends
    assert [each.step for each in board.Scalars("losses/td_error")] == rows
    assert [each.step for each in board.Histograms("replay/reuse")] == rows
    kept = [each.step for each in EventAccumulator(str(mine)).Reload().Scalars("charts/episodic_return")]
    assert kept == before[: len(kept)] != before, "nothing behind the checkpoint is left in the old file"


def test_the_closing_curve_shows_what_play_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, list[float]] = {}
    plot = Axes.plot

    def noted(self: Axes, steps: Any, returns: Any, *style: Any, label: str, **others: Any) -> Any:
        drawn[label] = list(returns)
        return plot(self, steps, returns, *style, label=label, **others)

    monkeypatch.setattr(Axes, "plot", noted)
    returns = [0.0] * 100 + [80.0] * 20
    path = draw_curve(range(120), returns, "a run", tmp_path / "x.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    assert drawn["episode"] == returns
    assert drawn["mean of the last 20"][-20:] == [4.0 * count for count in range(1, 21)]
