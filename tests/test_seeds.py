"""Lockstep runs side by side: each is to the bit what it is by itself."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from coop.common.errors import RunError
from coop.common.process.lifecycle import Stop
from coop.common.settings.config import RunConfig
from coop.common.settings.overrides import merged
from coop.common.settings.tables import load_tables, resolve
from coop.learner.trainer import EpisodeRow
from coop.lockstep.compiled.conditions import why_not
from coop.lockstep.compiled.seeds import Seeds
from coop.lockstep.compiled.together import play_together
from coop.lockstep.lockstep import Lockstep
from coop.lockstep.memory import TableMemory
from coop.lockstep.run import LockstepRun
from coop.records.checkpoints import ask, checkpoint_numbers
from coop.records.following import Callbacks
from coop.records.resumption import Start
from coop.records.run_directory import RunDirectory
from coop.records.summaries import Summary, read_summary

pytest.importorskip("numba")

OF_TIME = ("time", "updates_per_s", "env_steps_per_s")
SMALL: dict[str, Any] = {"replay": {"capacity": 100, "learning_starts": 50}, "total_steps": 2000}
NARROW: dict[str, Any] = {"network": {"hidden": [32, 32, 32]}}
PICTURES: dict[str, Any] = {"learner": {"batch_size": 8, "swap_every": 60}, "actor": {"epsilon_start": 0.4}}
OF_PRESET = {"cartpole": {}, "minatar-breakout": {**PICTURES, "total_steps": 390}}
SEVERAL: dict[str, Any] = {"replay": {"n_step": 3, "ratio": 0.3}, "checkpoint_every": 30}


def config_of(method: str, *changes: dict[str, Any], preset: str = "cartpole") -> RunConfig:
    tables = merged(load_tables(preset, None), SMALL)
    for each in changes:
        tables = merged(tables, each)
    return resolve(tables, method)


def fixed(run: Lockstep, player: int) -> Lockstep:
    """The run with one network that always acts."""
    always = {"acting": property(lambda _: player, lambda *_: None)}
    run._policy.__class__ = type("FixedPolicy", (type(run._policy),), always)
    return run


def alone(run: Lockstep, steps: int) -> tuple[list[EpisodeRow], list[dict[str, Any]]]:
    episodes, metrics = [], []
    while run.step < steps:
        for effects in run.play():
            episodes += effects.episodes
            metrics += [effects.metrics] if effects.metrics else []
    return episodes, metrics


def untimed(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name not in OF_TIME} for row in rows]


def assert_same(one: Lockstep, other: Lockstep) -> None:
    for mine, its in zip(one.agent.networks, other.agent.networks, strict=True):
        assert torch.equal(mine.flat, its.flat)
    for left, right in zip(one.agent.optimizers, other.agent.optimizers, strict=True):
        a, b = left.state(), right.state()
        assert a.keys() == b.keys()
        assert all(torch.equal(torch.as_tensor(a[name]), torch.as_tensor(b[name])) for name in a)
    for name in ("acting", "versions", "updates", "noise"):
        assert one.agent.state()[name] == other.agent.state()[name], name
    assert one.trainer.drawn == other.trainer.drawn
    assert (one._actions, one._seen) == (other._actions, other._seen)
    assert one._policy_rng.bit_generator.state == other._policy_rng.bit_generator.state
    assert isinstance(one.memory, TableMemory)
    assert isinstance(other.memory, TableMemory)
    first, second = one.memory.table.snapshot(), other.memory.table.snapshot()
    assert {**first.meta, "streams": 0} == {**second.meta, "streams": 0}
    for name in first.arrays.keys() - {"slots", "tails"}:
        np.testing.assert_array_equal(first.arrays[name], second.arrays[name], name)
    frames = [snapshot.frames.read()[snapshot.arrays["slots"]] for snapshot in (first, second)]
    np.testing.assert_array_equal(*frames)


CASES = {
    "dqn": ("dqn",),
    "coop": ("coop", {"network": {"hidden": [128, 128, 128]}}),
    "edql, other layers, s constant": ("edql", {"network": {"hidden": [48, 32]}, "edl": {"noise": "constant"}}),
    "g-coop, fifo, single": ("g-coop", {"learner": {"double": False, "loss": "huber"}, "replay": {"eviction": "fifo"}}),
    "two updates a step": ("coop", {"replay": {"ratio": 2.0, "eviction": "fifo"}, "learner": {"swap_every": 150}}),
    "updates after every step, of which rows tell between two": ("g-coop", {"replay": {"ratio": 1.5}}),
    "half of the updates": ("dqn", {"replay": {"ratio": 0.5}, "learner": {"swap_every": 50}}),
    "dead units": ("coop", {"network": {"hidden": [8, 4]}, "learner": {"learning_rate": 0.05}}),
    "rmsprop, mse, ends at a limit": (
        "coop",
        {
            "learner": {"optimizer": "rmsprop", "loss": "mse", "reward_bound": None},
            "env": {"max_episode_steps": 15, "time_limit_terminal": True},
        },
    ),
    "sgd, time limit": ("dqn", {"learner": {"optimizer": "sgd"}, "env": {"max_episode_steps": 15}}),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_run_is_to_the_bit_what_it_is_by_itself(case: str) -> None:
    method, *changes = CASES[case]
    assert_as_by_itself(config_of(method, NARROW, *changes), 500, (3, 4, 5))


def assert_as_by_itself(config: RunConfig, steps: int, numbers: Sequence[int]) -> None:
    """Of some seeds side by side the last one, and of three the first, is what it is by itself."""
    assert not why_not(config)
    configs = [replace(config, seed=seed) for seed in numbers]
    runs = [Lockstep(each) for each in configs]
    seeds = Seeds(runs)
    recorded: dict[Lockstep, tuple[list[EpisodeRow], list[dict[str, Any]]]] = {run: ([], []) for run in runs}
    while seeds.step < steps:
        for each in seeds.play(steps - seeds.step):
            recorded[each.run][0].extend(each.episodes)
            recorded[each.run][1].extend(each.metrics)
    for k in range(len(runs) - 1, -1, -2):
        own = Lockstep(configs[k])
        episodes, metrics = alone(own, seeds.step)
        assert recorded[runs[k]][0] == episodes
        assert untimed(recorded[runs[k]][1]) == untimed(metrics)
        assert len(episodes) > 5
        assert metrics
        seeds.save_into(k)
        assert_same(own, runs[k])


@pytest.mark.parametrize(("method", "player"), [("dqn", 1), ("g-coop", 0)])
def test_a_fixed_player_acts_as_one_that_lockstep_is_given(method: str, player: int) -> None:
    config = config_of(method)
    own, runs = fixed(Lockstep(config), player), [Lockstep(replace(config, seed=seed)) for seed in (config.seed, 1)]
    seeds = Seeds(runs, player)
    while seeds.step < 400:
        seeds.play(400 - seeds.step)
    alone(own, seeds.step)
    seeds.save_into(0)
    assert_same(own, runs[0])
    other = Lockstep(config)
    alone(other, seeds.step)
    assert other._actions != own._actions


WILD = (
    "g-coop",
    {
        "network": {"hidden": [16, 16]},
        "learner": {"optimizer": "sgd", "learning_rate": 4.0, "gamma": 0.99, "reward_bound": None},
        "total_steps": 400,
    },
)


def files_of(config: RunConfig, seeds: list[int], folder: Path, stop: Stop, *, together: bool) -> None:
    """Play runs in their directories, which they may have begun in."""
    with ExitStack() as stack:
        runs = []
        for seed in seeds:
            path = folder / str(seed)
            runs.append(LockstepRun(replace(config, seed=seed), path, "test", Start(resume=True), log="none"))
            stack.callback(runs[-1].close)
        if together:
            play_together(runs, stop)
        else:
            for run in runs:
                run.play(stop)


OF_STATE = (
    "env_step",
    "update",
    "acting",
    "q_gap",
    "archive_td_error",
    "policy_churn",
    "terminal_share",
    "effective_rank",
)


def assert_same_files(one: Path, other: Path, *, resumed: bool = False) -> None:
    """resumed: an interval of metrics starts over where a run goes on, whatever plays it."""
    for name in ("config.toml", "episodes.csv"):
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    texts = [(path / "metrics.jsonl").read_text().splitlines() for path in (one, other)]
    rows = [untimed([json.loads(line) for line in lines]) for lines in texts]
    if resumed:
        rows = [[{name: row.get(name) for name in OF_STATE} for row in lines] for lines in rows]
    assert rows[0] == rows[1]
    left, right = read_summary(one), read_summary(other)
    names = left.keys() - {"wall_seconds", "records"}
    assert {name: left[name] for name in names} == {name: right[name] for name in names}


WILDER: dict[str, Any] = {**PICTURES, "learner": {**PICTURES["learner"], "loss": "squared"}, "total_steps": 200}


def faster(ratio: float) -> dict[str, Any]:
    """Several updates a step, after each of which parameters are looked at."""
    return {"replay": {"ratio": ratio}, "learner": {"learning_rate": 6.0, "publish_every": 1}}


@pytest.mark.parametrize(
    ("preset", "changes", "seeds", "wild"),
    [
        ("cartpole", {}, [4, 5, 0], 5),
        ("minatar-breakout", WILDER, [4, 5, 0], 4),
        ("cartpole", faster(2.0), [8, 7, 0], 7),  # after the first of two updates
        ("cartpole", faster(3.0), [8], 8),  # found by a row of metrics
    ],
)
def test_a_seed_that_diverges_is_marked_and_the_others_go_on(
    preset: str, changes: dict[str, Any], seeds: list[int], wild: int, tmp_path: Path
) -> None:
    config = config_of(*WILD, changes, preset=preset)
    for name in ("together", "alone"):
        files_of(config, seeds, tmp_path / name, Stop(), together=name == "together")
    exits = {seed: read_summary(tmp_path / "together" / str(seed))["exit"] for seed in seeds}
    assert exits.pop(wild).startswith("diverged: ")
    assert set(exits.values()) <= {"complete"}
    for seed in seeds:
        assert_same_files(tmp_path / "together" / str(seed), tmp_path / "alone" / str(seed))


ENDS: dict[str, tuple[str, dict[str, Any]]] = {
    "target_return": ("cartpole", {"target_return": 9.0, "total_steps": 5000, "replay": {"eviction": "fifo"}}),
    "total_episodes": ("cartpole", {"total_episodes": 14, "checkpoint_every": 3}),
    "total_updates, two a step": ("cartpole", {"total_updates": 245, "replay": {"ratio": 2.0}}),
    "total_updates": ("cartpole", {"total_updates": 123, "learner": {"learning_rate_final": 1e-5}}),
    "total_episodes of games": ("minatar-breakout", {**PICTURES, "total_episodes": 9}),
    "total_episodes, weight-gradient": (
        "minatar-breakout",
        {**PICTURES, "total_episodes": 9, "edl": {"feedback": "weight-gradient", "noise": "constant"}},
    ),
    "total_episodes, returns over five": (
        "minatar-breakout",
        {**PICTURES, "total_episodes": 9, "replay": {"n_step": 5, "eviction": "reservoir"}},
    ),
}


@pytest.mark.parametrize("end", ENDS)
def test_each_run_ends_where_it_would_by_itself(end: str, tmp_path: Path) -> None:
    """And goes on from there, in the middle of a segment too."""
    preset, changes = ENDS[end]
    config, seeds = config_of("coop", NARROW, {"replay": {"ratio": 0.3}}, changes, preset=preset), [1, 2, 3]
    for name in ("together", "alone"):
        files_of(config, seeds, tmp_path / name, Stop(), together=name == "together")
    steps, waiting = set(), 0
    for seed in seeds:
        one, other = (tmp_path / name / str(seed) for name in ("together", "alone"))
        assert_same_files(one, other)
        assert read_summary(one)["exit"] == f"complete: {end.replace(',', ' ').split(maxsplit=1)[0]} reached"
        steps.add(read_summary(one)["env_steps"])
        with ExitStack() as stack:
            runs = [
                stack.enter_context(closing(LockstepRun(replace(config, seed=seed), path, "test", Start(resume=True))))
                for path in (one, other)
            ]
            assert_same(*(each.run for each in runs))
            waiting += runs[0].run.memory.waiting
    told = [(tmp_path / "together" / str(seed) / "episodes.csv").read_bytes() for seed in seeds]
    files_of(config, seeds, tmp_path / "together", Stop(), together=True)
    assert told == [(tmp_path / "together" / str(seed) / "episodes.csv").read_bytes() for seed in seeds]
    assert all(read_summary(tmp_path / "together" / str(seed))["env_steps"] in steps for seed in seeds)
    by_updates = end.startswith("total_updates")
    assert waiting > 0 or by_updates
    assert len(steps) == (1 if by_updates else 3)
    assert max(steps) < config.total_steps


class StopAt(Stop):
    """A stop after some blocks of steps."""

    def __init__(self, blocks: int) -> None:
        super().__init__()
        self._left = blocks

    def is_set(self) -> bool:
        self._left -= 1
        if self._left < 0:
            self.set("stopped")
        return super().is_set()


TWICE = {"total_steps": 600, "checkpoint_every": 130}


@pytest.fixture(scope="module", params=["cartpole", "minatar-breakout", "minatar-breakout, returns over three"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunConfig, Path]:
    """Two runs that have been played by themselves."""
    path = tmp_path_factory.mktemp("whole")
    preset, _, several = request.param.partition(",")
    config = config_of("coop", TWICE, OF_PRESET[preset], SEVERAL if several else {}, preset=preset)
    files_of(config, [1, 2], path, Stop(), together=False)
    return config, path


@pytest.mark.parametrize("first", ["together", "alone"])
def test_runs_go_on_where_they_stopped_whoever_had_begun_them(
    first: str, whole: tuple[RunConfig, Path], tmp_path: Path
) -> None:
    """Either way of playing goes on from the other's checkpoints; runs that are not equally far go on too."""
    config, path = whole
    one = first == "together"
    files_of(config, [1, 2], tmp_path / "parts", StopAt(2 if one else 123), together=one)
    stopped = [read_summary(tmp_path / "parts" / str(seed)) for seed in (1, 2)]
    assert stopped[0]["exit"] == "stopped"
    assert 0 < stopped[0]["env_steps"] < config.total_steps
    files_of(config, [1, 2], tmp_path / "parts", Stop(), together=not one)
    for seed in (1, 2):
        assert_same_files(path / str(seed), tmp_path / "parts" / str(seed), resumed=True)


LONG = {"total_steps": 600, "checkpoint_every": 130}


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Single runs of any length may be played by compiled loops; a list of where those began, by step."""
    from coop.lockstep.compiled import group  # noqa: PLC0415 (after importorskip)

    began, play_runs = [], group.play_runs

    def watched(files: dict[Lockstep, RunDirectory], *rest: Any) -> list[Summary]:
        began.extend(run.step for run in files)
        return play_runs(files, *rest)

    monkeypatch.setattr("coop.lockstep.run.WORTH_COMPILING", 1)
    monkeypatch.setattr(group, "play_runs", watched)
    return began


def play_one(path: Path, config: RunConfig, stop: Stop | None = None, callbacks: Callbacks | None = None) -> Summary:
    """Play a run, which may have begun, as `coop-lockstep --resume` does."""
    with closing(LockstepRun(config, path, "test", Start(resume=True))) as run:
        return run.play(stop or Stop(), callbacks=callbacks)


def test_a_single_run_in_compiled_loops_leaves_the_same_files(compiled: list[int], tmp_path: Path) -> None:
    config = config_of("coop", LONG)
    stopped = play_one(tmp_path / "compiled", config, StopAt(2))
    assert (stopped.exit, 0 < stopped.env_steps < 600) == ("stopped", True)
    assert play_one(tmp_path / "compiled", config).exit == "complete"
    assert compiled[0] == 0
    assert 0 < compiled[1] < 600
    files_of(config, [config.seed], tmp_path, Stop(), together=True)
    assert_same_files(tmp_path / "compiled", tmp_path / str(config.seed), resumed=True)
    del compiled[:]
    play_one(tmp_path / "short", replace(config, eval_every=300))
    assert not compiled, "evaluations are not theirs"


def test_callbacks_see_each_step(compiled: list[int], tmp_path: Path) -> None:
    seen: list[Any] = []
    callbacks = Callbacks({"on_episode": lambda row: bool(seen.append(row)) or len(seen) == 3})
    summary = play_one(tmp_path, config_of("coop", LONG), callbacks=callbacks)
    assert (summary.exit, summary.episodes, len(seen)) == ("stopped by on_episode", 3, 3)
    assert not compiled


@pytest.mark.parametrize(("ratio", "every"), [(1.0, 130), (1.5, 131)])
def test_checkpoints_are_where_they_are_without_compiled_loops(
    ratio: float, every: int, compiled: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of("coop", LONG, {"checkpoint_every": every, "replay": {"ratio": ratio}})
    saved: list[int] = []
    monkeypatch.setattr(Lockstep, "save", lambda run, directory: saved.append(run.step))
    play_one(tmp_path / "one", config)
    assert compiled
    first, saved[:] = list(saved), []
    play_one(tmp_path / "other", config, callbacks=Callbacks({"on_metrics": lambda row: None}))
    assert len(compiled) == 1
    assert first == saved
    assert len(first) > 3


def test_compiled_loops_save_a_checkpoint_on_request(
    compiled: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coop.lockstep.compiled.group.LOOK_EVERY", 0.0)
    config = config_of("coop", LONG, {"checkpoint_every": 0})
    saved: list[int] = []
    monkeypatch.setattr(Lockstep, "save", lambda run, directory: saved.append(run.step))
    tmp_path.joinpath("run").mkdir()
    ask(tmp_path / "run")
    play_one(tmp_path / "run", config)
    assert len(saved) == 2
    assert saved[0] < saved[1] == 600
    assert compiled


def test_a_run_that_fails_in_compiled_loops_keeps_its_newest_checkpoint(
    compiled: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a block has not told yet is in no file, so no checkpoint may hold it."""
    config, record = config_of("coop", LONG), RunDirectory.record

    def full(directory: RunDirectory, episodes: Any, metrics: Any) -> None:
        if metrics is not None and metrics["update"] >= 400:
            raise RunError("no space")
        record(directory, episodes, metrics)

    with monkeypatch.context() as broken:
        broken.setattr(RunDirectory, "record", full)
        with pytest.raises(RunError, match="no space"):
            play_one(tmp_path / "run", config)
    assert read_summary(tmp_path / "run")["exit"] == "failed: no space"
    assert checkpoint_numbers(tmp_path / "run")[-1] < 400
    play_one(tmp_path / "run", config)
    files_of(config, [config.seed], tmp_path, Stop(), together=False)
    assert_same_files(tmp_path / "run", tmp_path / str(config.seed), resumed=True)


def test_a_numba_that_can_not_be_imported_costs_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("coop.lockstep.run.WORTH_COMPILING", 1)
    monkeypatch.setitem(sys.modules, "coop.lockstep.compiled.group", None)
    assert play_one(tmp_path, config_of("dqn", {"total_steps": 100})).exit == "complete"
    assert capsys.readouterr().out.count("plays without compiled loops: ") == 1


def test_a_cartpole_of_ones_own_is_played_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = replace(gymnasium.spec("CartPole-v1"), kwargs={"sutton_barto_reward": True})
    monkeypatch.setitem(gymnasium.registry, "CartPole-v1", spec)
    config = config_of("dqn", {"env": {"id": "CartPole-v1"}})
    assert why_not(config) == "env: CartPole-v1 is registered as something else"


REFUSED = {
    "replay.sampling": {"replay": {"sampling": "prioritized"}},
    "env": {"env": {"id": "Acrobot-v1"}}, "edl.feedback": {"edl": {"feedback": "random"}},
    "eval_every": {"eval_every": 9},
    "network.kind": {"network": {"hidden": []}}, "learner.weight_decay": {"learner": {"weight_decay": [0.1]}},
    "replay.n_step": {"replay": {"n_step": 3}},
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_can_not_be_played_side_by_side_says_why(name: str) -> None:
    assert why_not(config_of("coop", REFUSED[name])).startswith(f"{name}: only ")
