"""Configs: presets resolve, TOML comes back, and what can't be right is refused by field and value."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from common.errors import UsageError
from common.process.cli import base_config
from common.settings import schedules
from common.settings.config import ActorSettings, EdlSettings, LearnerSettings
from common.settings.options import RunOptions, parse_run
from common.settings.tables import load_tables, preset_names, resolve, to_toml


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop"])
def test_presets_resolve_and_come_back_from_toml(preset: str, method: str) -> None:
    resolved = resolve(load_tables(preset, None), method)
    assert resolved.method == method
    assert resolve(tomllib.loads(to_toml(resolved))) == resolved


def test_a_method_table_overrides_the_rest() -> None:
    assert base_config(["--method", "g-coop"]).learner.optimizer == "adam"
    assert base_config(["--method", "coop"]).learner.optimizer == "rmsprop"


@pytest.mark.parametrize(
    ("flags", "start"),
    [
        ([], 50_000),
        (["--total-steps", "20_000"], 2000),
        (["--total_steps=20000"], 2000),
        (["--total-steps", "1000000"], 50_000),
        (["--total-steps", "9"], 1),
        (["--total-steps", "20000", "--replay.start", "7000"], 7000),
    ],
)
def test_a_short_run_of_a_long_preset_learns(flags: list[str], start: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["coop-local", "--preset", "breakout", *flags])
    assert parse_run(RunOptions, "coop-local", "").run_config().replay.start == start


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--preset", "cartpol"], ["--preset", "cartpol", "cartpole"]),
        (["--replay.capacity", "-5"], ["replay.capacity", "-5", "greater than 0"]),
        (["--learner.swap-every", "0"], ["learner.swap_every", "0", "greater than 0"]),
        (["--replay.capcity", "5"], ["--replay.capcity", "--replay.capacity"]),
        (["--seed", "x"], ["--seed", "x"]),
        (["--method", "sarsa"], ["method", "sarsa", "g-coop"]),
        (["--edl.rate", "nan"], ["edl.rate", "nan"]),
        (["--replay.start", "400", "--replay.capacity", "300"], ["replay.start", "400", "300"]),
        (["--total-steps", "100", "--replay.start", "128"], ["replay.start", "128", "100"]),
        (["--total-steps", "0"], ["total_steps", "0", "greater than 0"]),
        (["--total-steps", "many"], ["--total-steps", "many"]),
        (["--run", "a/b"], ["run", "a/b"]),
        (["--config", "/no/such.toml"], ["--config", "/no/such.toml"]),
        (["--preset", "cartpole", "--config", "x"], ["--preset", "--config"]),
    ],
)
def test_refused_in_one_line(flags: list[str], words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["coop-local", *flags])
    with pytest.raises(UsageError) as caught:
        parse_run(RunOptions, "coop-local", "").run_config()
    text = str(caught.value)
    assert "\n" not in text
    assert not [word for word in words if word not in text], text
    assert caught.value.exit_status == 2


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"replay": {"capcity": 5}}, "replay.capcity = 5: no such field; allowed: capacity, start"),
        ({"speed": 5}, "speed = 5: no such field; allowed: run, method"),
        ({"replay": 5}, "replay = 5"),
        ({"replay": {"capacity": "many"}}, "replay.capacity = 'many'"),
    ],
)
def test_files_are_refused_by_field(tables: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError) as caught:
        resolve(tables)
    assert words in str(caught.value)


def test_a_file_that_is_not_toml(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text("a = = 1")
    with pytest.raises(UsageError, match=r"c\.toml"):
        load_tables(None, path)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (schedules.epsilon(ActorSettings(epsilon_start=1, epsilon_final=0.1, epsilon_steps=100), 0), 1.0),
        (schedules.epsilon(ActorSettings(epsilon_start=1, epsilon_final=0, epsilon_steps=100), 100), 0.36787944),
        (schedules.epsilon(ActorSettings(1, 1.0, 0.1, "linear", 100), 50), 0.55),
        (schedules.epsilon(ActorSettings(1, 1.0, 0.1, "linear", 100), 500), 0.1),
        (schedules.exploration_rate(EdlSettings(rate=0.1, decay=0.5, decay_every=10), 20), 0.025),
        (schedules.learning_rate(LearnerSettings(learning_rate=1.0, learning_rate_final=0.01), 0.5), 0.1),
        (schedules.learning_rate(LearnerSettings(learning_rate=1.0, learning_rate_final=0.01), 3.0), 0.01),
    ],
)
def test_schedules(value: float, expected: float) -> None:
    assert value == pytest.approx(expected)


def test_a_shorter_run_of_a_preset_is_how_the_longer_one_begins() -> None:
    whole = base_config(["--preset", "cartpole"])
    half = base_config(["--preset", "cartpole", "--total-steps", str(whole.total_steps // 2)])
    double = base_config(["--preset", "cartpole", "--total-steps", str(whole.total_steps * 2)])
    for share in (0.1, 0.5, 1.0):
        expected = schedules.learning_rate(whole.learner, share / 2)
        assert schedules.learning_rate(half.learner, share) == pytest.approx(expected)
        assert schedules.learning_rate(double.learner, share) == schedules.learning_rate(whole.learner, share)
