"""Configs, flags and grids with the names of earlier versions mean what they meant, and one line says the new names."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from coop.common.errors import UsageError
from coop.common.process import notices
from coop.common.settings.config import LearnerSettings, RunConfig
from coop.common.settings.tables import load_tables, resolve, to_tables
from coop.records.run_options import RunOptions, parse_run
from coop.studies.sweep.grid import load_grid

# The parts with other names of `config.toml` as version 0.1.0 wrote it, which held every field.
OLD = """
method = "g-coop"
total_steps = 400

[learner]
swap_every = 30
swap_by = "plays"
optimizer = "{optimizer}"
momentum = {momentum}
squared_decay = 0.97
denominator = 1e-06

[replay]
capacity = 5000
start = 40
"""


@pytest.fixture(autouse=True)
def _nothing_told_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notices, "_told", set())


@pytest.mark.parametrize(
    ("optimizer", "momentum", "expected"),
    [
        ("adam", 0.0, {"beta1": 0.9, "beta2": 0.97}),  # 0 stood for 0.9
        ("adam", 0.8, {"beta1": 0.8, "beta2": 0.97}),
        ("rmsprop", 0.8, {"momentum": 0.8, "alpha": 0.97}),
        ("rmsprop-mnih", 0.8, {"gradient_alpha": 0.8, "alpha": 0.97}),
        ("rmsprop-mnih", 0.0, {"gradient_alpha": 0.0, "alpha": 0.97}),
        ("sgd", 0.8, {"momentum": 0.8}),
    ],
)
def test_an_earlier_config_means_what_it_meant(
    optimizer: str, momentum: float, expected: dict[str, float], capsys: pytest.CaptureFixture[str]
) -> None:
    tables = tomllib.loads(OLD.format(optimizer=optimizer, momentum=momentum))
    config = resolve(tables)
    settings = config.learner
    assert {name: getattr(settings, name) for name in expected} == expected
    assert (settings.eps, settings.swap_unit, config.replay.learning_starts) == (1e-6, "steps", 40)
    assert settings.target_update_every is None
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("note: replay.start is now replay.learning_starts, learner.swap_by is now learner.swap_unit")
    assert "learner.denominator is now learner.eps" in line
    resolve(tables)
    assert resolve(to_tables(config)) == config
    assert capsys.readouterr().err == ""


def test_tables_of_methods_and_presets_of_earlier_versions() -> None:
    tables = {
        "learner": {"optimizer": "rmsprop-mnih", "momentum": 0.95, "squared_decay": 0.95, "denominator": 0.01},
        "methods": {"g-coop": {"learner": {"optimizer": "adam", "momentum": 0.8, "squared_decay": 0.99}}},
    }
    coop, g_coop = resolve(tables).learner, resolve(tables, "g-coop").learner
    assert coop == LearnerSettings(optimizer="rmsprop-mnih", gradient_alpha=0.95, alpha=0.95, eps=0.01)
    assert g_coop == LearnerSettings(optimizer="adam", beta1=0.8, beta2=0.99, eps=0.01, gradient_alpha=0.95, alpha=0.95)


def test_both_names_are_refused() -> None:
    with pytest.raises(UsageError, match=r"replay\.start and replay\.learning_starts: two names of one setting"):
        resolve({"replay": {"start": 3, "learning_starts": 4}})


@pytest.mark.parametrize(
    ("flags", "expected", "line"),
    [
        (["--replay.start", "7"], {"replay.learning_starts": 7}, "--replay.start is now --replay.learning-starts"),
        (["--replay.start=7"], {"replay.learning_starts": 7}, "--replay.start is now --replay.learning-starts"),
        (["--learner.denominator", "1"], {"learner.eps": 1.0}, "--learner.denominator is now --learner.eps"),
        (
            ["--learner.swap-by", "plays"],
            {"learner.swap_unit": "steps"},
            "--learner.swap-by is now --learner.swap-unit",
        ),
        (
            ["--learner.swap_by=updates"],
            {"learner.swap_unit": "updates"},
            "--learner.swap_by is now --learner.swap-unit",
        ),
        (
            ["--learner.squared-decay", "0.5"],
            {"learner.alpha": 0.5},
            "--learner.squared-decay is now --learner.alpha",
        ),
        (
            ["--method", "g-coop", "--learner.squared-decay", "0.5"],
            {"learner.beta2": 0.5},
            "--learner.squared-decay is now --learner.beta2",
        ),
        (
            ["--learner.momentum", "0.5", "--learner.optimizer=adam"],
            {"learner.beta1": 0.5},
            "--learner.momentum is now --learner.beta1",
        ),
        (["--learner.momentum", "0.5"], {"learner.momentum": 0.5}, ""),
        (
            ["--method", "dqn", "--learner.swap-every", "7"],
            {"swap_period": 7, "learner.swap_every": 7},
            "--learner.swap-every is now --learner.target-update-every for dqn",
        ),
        (["--method", "dqn", "--learner.target-update-every", "7"], {"swap_period": 7, "learner.swap_every": 30}, ""),
        (["--method", "coop", "--learner.swap-every", "7"], {"swap_period": 7}, ""),
    ],
)
def test_earlier_flags(
    flags: list[str],
    expected: dict[str, Any],
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("sys.argv", ["coop-lockstep", "--preset", "cartpole-paper", *flags])
    config = parse_run(RunOptions, "coop-lockstep", "", lockstep=True).run_config()
    assert {name: _value(config, name) for name in expected} == expected
    assert capsys.readouterr().err == (f"note: {line}\n" if line else "")


def _value(config: RunConfig, name: str) -> Any:
    value: Any = config
    for part in name.split("."):
        value = getattr(value, part)
    return value


def test_grids_of_earlier_versions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "g.toml"
    path.write_text(
        'preset = "cartpole-paper"\nmethods = ["coop", "g-coop"]\n'
        "[fixed]\nreplay.start = 50\nlearner.denominator = 1e-5\n"
        "[vary]\nlearner.squared_decay = [0.5, 0.6]\n"
    )
    cells = {cell.name: cell.config for cell in load_grid(str(path)).cells}
    assert next(iter(cells)) == "coop-squared_decay=0.5-seed=0"  # the folder of an earlier sweep goes on
    assert cells["coop-squared_decay=0.6-seed=0"].learner.alpha == 0.6
    assert cells["g-coop-squared_decay=0.6-seed=0"].learner.beta2 == 0.6
    assert {config.replay.learning_starts for config in cells.values()} == {50}
    assert {config.learner.eps for config in cells.values()} == {1e-5}
    assert "replay.start is now replay.learning_starts" in capsys.readouterr().err


def test_presets_have_the_present_names(capsys: pytest.CaptureFixture[str]) -> None:
    for preset in ("cartpole", "breakout", "breakout-small", "catch"):
        resolve(load_tables(preset, None), "g-coop")
    assert capsys.readouterr().err == ""
