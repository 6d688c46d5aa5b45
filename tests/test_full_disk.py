"""A full disk: what grows waits for space, checkpoints are given up one by one, and nothing ends in a traceback."""

import contextlib
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from coop.common.errors import RunError
from coop.common.process.files import LineFile
from coop.common.process.lifecycle import Stop
from coop.learner.summary import summarise
from coop.lockstep.lockstep import Lockstep
from coop.lockstep.run import play_lockstep
from coop.records.checkpoints import checkpoint_numbers
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config


def _fill(disk: Path) -> Path:
    """Leave no byte free; the file that takes the space."""
    filler = disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    assert not os.statvfs(disk).f_bavail
    return filler


def _lockstep() -> Lockstep:
    config = base_config(["--method", "coop"])
    replay = replace(config.replay, learning_starts=50)
    return Lockstep(replace(config, total_steps=600, checkpoint_every=200, replay=replay))


def test_lines_wait_for_space(small_disk: Path) -> None:
    lines = LineFile(small_disk / "lines", go_on=False)
    (small_disk / "filler").write_bytes(bytes(250_000))
    written = ""
    while not lines.problem:
        lines.write(line := f"a line {len(written)}\n")
        written += line
    assert lines.problem == "No space left on device"
    assert not (small_disk / "lines").read_text().endswith("\n"), "there was space for a part of the last line"
    (small_disk / "filler").unlink()
    lines.write("the end\n")
    assert not lines.problem
    lines.close()
    assert (small_disk / "lines").read_text() == f"{written}the end\n"


def test_episodes_metrics_and_scalars_wait_for_space(small_disk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, path = _lockstep(), small_disk / "run"
    with RunDirectory(path, run.config) as directory:
        threads = threading.active_count()
        filler, rows = _fill(small_disk), 0
        for _ in range(run.config.total_steps):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
                rows += effects.metrics is not None
        summary = summarise(run.trainer, "complete", time.monotonic(), run.step)
        with pytest.raises(RunError, match="No space left on device; how the run ended: complete"):
            directory.conclude(summary, "a run")
        assert threading.active_count() == threads, "TensorBoard's file needs no thread that could die of this"
        filler.unlink()
        directory.conclude(summary, "a run")
        assert len((path / "episodes.csv").read_text().splitlines()) == 1 + summary.episodes
        assert len((path / "metrics.jsonl").read_text().splitlines()) == rows > 0
    run.env.close()
    assert capsys.readouterr().out == f"{path}: No space left on device\n"
    assert (path / "learning_curve.png").stat().st_size
    board = EventAccumulator(str(path / "tb")).Reload()
    assert len(board.Scalars("charts/episodic_return")) == summary.episodes
    assert len(board.Scalars("losses/td_error")) == rows


@pytest.mark.parametrize("compiled", [False, True])
def test_a_lockstep_run_goes_on_without_its_checkpoints(
    compiled: bool, small_disk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if compiled:
        pytest.importorskip("numba")
        from coop.lockstep.compiled.group import play_runs  # noqa: PLC0415
    run, path = _lockstep(), small_disk / "run"
    with RunDirectory(path, run.config) as directory:
        _fill(small_disk)
        with pytest.raises(RunError, match=r"how the run ended: failed: checkpoint 550 in .*: No space left on device"):
            play_runs({run: directory}, Stop()) if compiled else play_lockstep(run, directory, Stop())
    run.env.close()
    assert run.step == run.config.total_steps
    assert checkpoint_numbers(path) == []
    assert "checkpoint 200 in" in (printed := capsys.readouterr().out)
    assert printed.count("No space left on device; the run goes on without it\n") == 2


@pytest.mark.parametrize(
    ("body", "status", "problem"),
    [
        ("console.event('joined')", 0, ""),  # its log may be on the disk that is full
        ("print('a table', flush=True)", 1, "coop-x: error: output: No space left on device\n"),
    ],
)
def test_a_full_log(body: str, status: int, problem: str) -> None:
    code = f"""
from coop.common.process.console import Console
from coop.common.process.lifecycle import run_main
console = Console()
run_main("coop-x", lambda: {body})
"""
    buffering = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=buffering
        )
    assert (done.returncode, done.stderr) == (status, problem)
