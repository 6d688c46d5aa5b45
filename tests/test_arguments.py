"""What the functions of the Python API are given that is of another type than they take: a line that names it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import coop
from coop.common.arguments import check_seconds, check_whole, texts

WRONG: Any = object()


class Failing:
    def __array__(self, *_: Any, **__: Any) -> Any:
        raise KeyError("no")


ENDLESS: dict[str, Any] = {}
ENDLESS["more"] = ENDLESS
DEEP: list[Any] = []
for _ in range(5_000):
    DEEP = [DEEP]
GRID = {"fixed": {"total_steps": 40}, "seeds": [0]}


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> coop.SavedRun:
    path = tmp_path_factory.mktemp("runs") / "a"
    coop.train(run_dir=path, total_steps=40).wait()
    return coop.load(path)


@pytest.mark.parametrize("wrong", [True, np.True_, 0, 6, np.int64(6), 2.0, "2", None])
def test_whole_numbers(wrong: Any) -> None:
    for right in (1, 5, np.int64(5), np.uint8(1)):
        check_whole("n", right, 1, 5)
    check_whole("n", 10**30, 1)
    with pytest.raises(coop.UsageError, match=f"^n = {re.escape(repr(wrong))}: must be a whole number from 1 to 5$"):
        check_whole("n", wrong, 1, 5)


@pytest.mark.parametrize("wrong", [True, -0.5, float("nan"), float("-inf"), "2", None, 1j])
def test_seconds(wrong: Any) -> None:
    for right in (0, 2.5, np.float32(0.5), float("inf")):
        check_seconds("wait", right)
    with pytest.raises(coop.UsageError, match=f"^wait = {re.escape(repr(wrong))}: must be a number of seconds from 0"):
        check_seconds("wait", wrong)


@pytest.mark.parametrize("wrong", ["envs", b"envs", {"envs": 1}, 5, None])
def test_lists_of_names(wrong: Any) -> None:
    for right in (["a", "b"], ("a", "b"), {"a": 1, "b": 2}.keys(), iter("ab")):
        assert texts("names", right) == ["a", "b"]
    with pytest.raises(coop.UsageError, match=f"^names = {re.escape(repr(wrong))}: must be a list of names$"):
        texts("names", wrong)


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


@pytest.mark.parametrize("path", ["a" * 300, "loop/a"])
def test_paths_that_no_file_system_takes(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    for name, call in (("run_dir", coop.load), ("folder", lambda path: coop.tune(GRID, path))):
        with pytest.raises(coop.UsageError, match=f"^{name} = '{path}': (File name too long|Too many levels of )"):
            call(path)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda path: coop.train(run_dir=path, actors="2"), "actors = '2': must be a whole number"),
        (lambda path: coop.train(run_dir=path, actors=1.5, distributed=True), r"actors = 1\.5: must be a whole number"),
        (lambda path: coop.train(run_dir=path, resume="no"), "resume = 'no': must be True or False"),
        (lambda path: coop.train(run_dir=path, overwrite=0), "overwrite = 0: must be True or False"),
        (lambda path: coop.train(run_dir=path, distributed=None), "distributed = None: must be True or False"),
        (lambda path: coop.train(run_dir=path, resume_from=True), "resume_from = True: must be a whole number from 0"),
        (lambda path: coop.sweep(GRID, path, quick="no"), "quick = 'no': must be True or False"),
        (lambda path: coop.train(run_dir=path, method=[]), r"method = \[\]: expected str"),
        (lambda path: coop.train(run_dir=path, replay={5: 6}), "replay.5 = 6: no such field"),
        (
            lambda path: coop.train(run_dir=path, **{"replay.capacity": 50}),
            r'replay.capacity = 50: no such field; did you mean replay=\{"capacity": ...\}\?',
        ),
        (lambda path: coop.train(run_dir=path, replay=ENDLESS), "replay.more: nests more than 32 tables"),
        (lambda path: coop.train(run_dir=path, env={"kwargs": ENDLESS}), "env.kwargs: nests more than 32 tables"),
        (lambda path: coop.train(run_dir=path, env={"kwargs": {"a": DEEP}}), "env.kwargs = .*: nests more than 29"),
        (lambda path: coop.evaluate(print, env={"kwargs": ENDLESS}), "env.kwargs = .*: nests more than 29 tables"),
        (lambda path: coop.train(run_dir=path, log=5), "log = 5: must be a list of names"),
        (lambda path: coop.train(run_dir=path, log=[None]), "log: None is no name"),
        (lambda path: coop.train(run_dir=path, allow_import="envs"), "allow_import = 'envs': must be a list of names"),
        (lambda path: coop.train(run_dir=path, allow_import=None), "allow_import = None: must be a list of names"),
        (lambda path: coop.tune(GRID, path, trials=None), "trials = None: must be a whole number from 1 on"),
        (lambda path: coop.tune(GRID, path, workers="1"), "workers = '1': must be a whole number from 1 on"),
        (lambda path: coop.tune(GRID, path, seed=-1), "seed = -1: must be a whole number from 0"),
        (lambda path: coop.sweep(GRID, path, stack="2"), "stack = '2': must be a whole number from 1 on"),
        (lambda path: coop.sweep(GRID, path, jobs="2"), "jobs = '2': must be a whole number from 1 on"),
        (
            lambda path: coop.sweep(GRID, path, jobs=10**6),
            "jobs 1,000,000: need 62,500.0 GiB and more; this machine has",
        ),
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
        (lambda run: run.buffer(live="no"), "live = 'no': must be True or False"),
        (lambda run: run.q_values(torch.zeros(4, requires_grad=True)), "observation: not an array: RuntimeError: "),
        (lambda run: run.q_values(Failing()), "observation: not an array: KeyError: 'no'"),
        (lambda run: run.q_values(np.ma.masked_equal([0, 1, 2, 3.0], 2)), "observation: has masked entries"),
        (lambda run: run.policy()([0, 0, 0, 0], Failing()), "mask: not an array: KeyError: 'no'"),
        (lambda run: run.policy()([0] * 4, np.ma.masked_equal([1, 0], 0)), "mask: has masked entries"),
        (
            lambda run: coop.evaluate(lambda obs: Failing(), env=run.config.env.id),
            "policy: what it gives: not an array",
        ),
        (lambda run: run.film(seed="x"), "seed = 'x': must be a whole number"),
        (lambda run: run.buffer(live=True, timeout=None), "timeout = None: must be a number of seconds"),
        (lambda run: run.buffer(timeout=float("nan")), "timeout = nan: must be a number of seconds"),
        (lambda run: coop.evaluate(run.policy(), episodes="1"), "episodes = '1': must be a whole number"),
        (lambda run: coop.evaluate(run.policy(), seed=None), "seed = None: must be a whole number"),
        (lambda run: coop.evaluate(run.policy(), at_once=0), "at_once = 0: must be a whole number"),
        (lambda run: coop.evaluate(run.policy(), epsilon=True), "epsilon = True: must be from 0 to 1"),
        (lambda run: coop.evaluate(run.policy(), epsilon="0"), "epsilon = '0': must be from 0 to 1"),
        (lambda run: coop.evaluate(run.policy(), env=5), "env = 5: must be an id"),
        (lambda run: coop.evaluate(None), "policy: NoneType is no function"),  # type: ignore[arg-type]
        (
            lambda run: coop.evaluate(lambda obs: [0, [1]], env=run.config.env.id),
            "policy: what it gives: not an array: ValueError: ",
        ),
    ],
)
def test_what_reads_runs(call: Callable[[coop.SavedRun], object], said: str, saved: coop.SavedRun) -> None:
    with pytest.raises(coop.UsageError, match=f"^{said}"):
        call(saved)
