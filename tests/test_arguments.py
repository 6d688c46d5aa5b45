"""What the functions of the Python API are given that is of another type than they take: a line that names it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import coop

WRONG: Any = object()
GRID = {"fixed": {"total_steps": 40}, "seeds": [0]}


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> coop.SavedRun:
    path = tmp_path_factory.mktemp("runs") / "a"
    coop.train(run_dir=path, total_steps=40).wait()
    return coop.load(path)


@pytest.mark.parametrize("wrong", [None, 5, b"a", [], WRONG], ids=["None", "number", "bytes", "list", "object"])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("run_dir", coop.load),
        ("folder", coop.load_sweep),
        ("folder", lambda path: coop.tune(GRID, path)),
        ("folder", lambda path: coop.sweep(GRID, path)),
        ("grid", lambda path: coop.tune(path, "none")),
        ("run_dir", lambda path: coop.train(run_dir=path)),
        ("config", lambda path: coop.train(config=path)),
    ],
    ids=["load", "load_sweep", "tune", "sweep", "grid", "train", "config"],
)
def test_paths(
    name: str, call: Callable[[Any], object], wrong: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if wrong is None and name != "grid" and call not in (coop.load, coop.load_sweep):
        return  # which is the default, or needs a name for another reason
    monkeypatch.chdir(tmp_path)
    with pytest.raises(coop.UsageError, match=f"^{name} = .*: must be a path"):
        call(wrong)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda path: coop.train(run_dir=path, actors="2"), "actors = '2': must be a whole number"),
        (lambda path: coop.train(run_dir=path, actors=1.5, distributed=True), r"actors = 1\.5: must be a whole number"),
        (lambda path: coop.train(run_dir=path, method=[]), r"method = \[\]: expected str"),
        (lambda path: coop.train(run_dir=path, replay={5: 6}), "replay.5 = 6: no such field"),
        (lambda path: coop.train(run_dir=path, log=5), "log = 5: must be a list of names"),
        (lambda path: coop.train(run_dir=path, log=[None]), "log: None is no name"),
        (lambda path: coop.train(run_dir=path, allow_import="envs"), "allow_import = 'envs': must be a list of names"),
        (lambda path: coop.train(run_dir=path, allow_import=None), "allow_import = None: must be a list of names"),
        (lambda path: coop.tune(GRID, path, trials=None), "trials = None: must be a whole number from 1 on"),
        (lambda path: coop.tune(GRID, path, workers="1"), "workers = '1': must be a whole number from 1 on"),
        (lambda path: coop.tune(GRID, path, seed=-1), "seed = -1: must be a whole number from 0"),
        (lambda path: coop.sweep(GRID, path, jobs="2"), "jobs = '2': must be a whole number from 1 on"),
        (lambda path: coop.sweep({5: {}}, path), "grid: .*5"),
        (lambda path: coop.sweep({"fixed": {"seed": WRONG}}, path), "grid: .*object"),
    ],
)
def test_what_starts_runs(call: Callable[[Path], object], said: str, tmp_path: Path) -> None:
    with pytest.raises(coop.UsageError, match=f"^{said}"):
        call(tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda run: coop.load(run.path, allow_import=5), "allow_import = 5: must be a list of names"),
        (lambda run: run.policy(1.0), r"network = 1\.0: allowed"),
        (lambda run: run.policy(True), "network = True: allowed"),
        (lambda run: run.film(seed="x"), "seed = 'x': must be a whole number"),
        (lambda run: run.buffer(live=True, timeout=None), "timeout = None: must be a number of seconds"),
        (lambda run: run.buffer(timeout=float("nan")), "timeout = nan: must be a number of seconds"),
        (lambda run: coop.evaluate(lambda obs: [0, [1]], env=run.config.env.id), "policy: gives what is no array"),
    ],
)
def test_what_reads_runs(call: Callable[[coop.SavedRun], object], said: str, saved: coop.SavedRun) -> None:
    with pytest.raises(coop.UsageError, match=f"^{said}"):
        call(saved)
