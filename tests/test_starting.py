"""What a run starts from: presets of environments, neutral settings for others, and what gives way to flags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from commands import run_command

import coop
from coop.common.errors import UsageError
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import load_tables, resolve, to_tables
from coop.records.run_options import RunOptions, parse_run
from coop.studies.sweep.cli import settings_of
from coop.studies.sweep.folder import CellFolder
from coop.studies.sweep.grid import parse_grid

OWN = ("--env.id", "my_envs:Room-v0")


def options(monkeypatch: pytest.MonkeyPatch, *flags: str, lockstep: bool = True) -> RunOptions:
    monkeypatch.setattr("sys.argv", ["coop-lockstep", *flags])
    return parse_run(RunOptions, "coop-lockstep", "", lockstep=lockstep)


@pytest.mark.parametrize("steps", [None, "400", "2e6"])
def test_an_environment_of_one_s_own_gets_neutral_settings(steps: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    found = options(monkeypatch, *OWN, *(["--total-steps", steps] if steps else []))
    config = found.run_config()
    total = int(float(steps)) if steps else 50_000
    assert config.total_steps == total
    assert (config.learner.gamma, config.learner.reward_bound) == (0.99, None)
    assert (config.replay.eviction, config.replay.sampling) == ("fifo", "uniform")
    assert (config.actor.epsilon_decay, config.actor.epsilon_steps) == ("linear", total // 10)
    assert config.replay.learning_starts == min(500, total // 10)
    assert found.settings == (
        "settings: no preset: neutral; method: coop; gamma: 0.99; replay: capacity 5,000, eviction fifo, "
        "sampling uniform, ratio 1; network: mlp-128-128-128"
    )


@pytest.mark.parametrize(
    ("env", "preset"),
    [(None, "cartpole"), ("CartPole-v0", "cartpole"), ("coop/Catch-v0", "catch"), ("breakout", "breakout"),
     ("MinAtar/Seaquest-v1", "minatar-seaquest")],
)  # fmt: skip
def test_an_environment_with_a_preset_gets_it(env: str | None, preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = ["--env.id", env] if env else []
    found = options(monkeypatch, *flags, lockstep=False)
    assert found.run_config() == resolve(load_tables(preset, None))
    assert found.settings.startswith(f"settings: preset {preset}; ")


def test_another_ale_game_gets_the_preparation_of_atari_games(monkeypatch: pytest.MonkeyPatch) -> None:
    found = options(monkeypatch, "--env.id", "ALE/MontezumaRevenge-v5", lockstep=False)
    expected = to_tables(resolve(load_tables("breakout", None)))
    expected["env"]["id"] = "ALE/MontezumaRevenge-v5"
    assert to_tables(found.run_config()) == expected
    assert found.settings.startswith("settings: no preset: those of the Atari presets; ")


def test_what_nobody_asked_for_gives_way(monkeypatch: pytest.MonkeyPatch) -> None:
    for flags in ((), OWN, ("--preset", "breakout")):
        config = options(monkeypatch, *flags, "--replay.capacity", "16").run_config()
        assert (config.replay.capacity, config.replay.learning_starts, config.actor.num_envs) == (16, 16, 1)
    assert options(monkeypatch, "--preset", "breakout", "--actor.num-envs", "8").actor.num_envs == 8
    assert options(monkeypatch, "--preset", "breakout", lockstep=False).actor.num_envs == 8
    with pytest.raises(UsageError, match=r"replay.learning_starts = 20: must not exceed replay.capacity = 16"):
        options(monkeypatch, "--replay.capacity", "16", "--replay.learning-starts", "20").run_config()


def test_files_say_what_they_want_and_get_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('total_steps = 900\n[replay]\ncapacity = 16\n[learner]\nreward_bound = "None"\n')
    found = options(monkeypatch, "--config", str(file))
    assert (found.replay.learning_starts, found.actor.epsilon_steps) == (16, 90)
    assert found.settings.startswith(f"settings: file {file}; ")
    longer = options(monkeypatch, "--config", str(file), "--total-steps", "5000")
    assert (longer.total_steps, longer.actor.epsilon_steps) == (5000, 500)


def test_none_is_written_and_read(monkeypatch: pytest.MonkeyPatch) -> None:
    assert resolve({**load_tables("cartpole", None), "learner": {"reward_bound": "none"}}).learner.reward_bound is None
    assert options(monkeypatch, "--learner.reward-bound", "None").learner.reward_bound is None
    for path, name in (("learner", "target_update_every"), ("learner", "tau"), ("env", "resize")):
        assert getattr(getattr(resolve({path: {name: "None"}}), path), name) is None
    assert resolve({"target_return": "None"}).target_return is None
    unset = {"learner": {"reward_bound": 1.0}, "methods": {"dqn": {"learner": {"reward_bound": "None"}}}}
    bounded = {"methods": {"coop": {"learner": {"reward_bound": 1.0}}}}
    for tables in (unset, bounded):
        of_coop = resolve(tables, "coop")
        assert of_coop.learner.reward_bound == 1
        again = resolve(to_tables(of_coop), "dqn")
        assert again.learner.reward_bound is None, "also behind a resolved config"


def test_grids_without_a_preset(tmp_path: Path) -> None:
    def only(text: str) -> RunConfig:
        (cell,) = parse_grid(text, "g").cells
        return cell.config

    assert only('methods = ["dqn"]') == resolve(load_tables("cartpole", None), "dqn")
    own = only('methods = ["dqn"]\n[fixed]\nenv.id = "CartPole-v1"\ntotal_steps = 3000\nreplay.capacity = 40\n')
    assert (own.learner.gamma, own.replay.eviction, own.replay.learning_starts) == (0.99, "fifo", 40)
    assert own.actor.epsilon_steps == 300
    catch = only('methods = ["dqn"]\npreset = "catch"\n')
    assert catch.actor.num_envs == 1, "lockstep cells play one emulator"


def test_a_sweep_says_what_its_cells_share(tmp_path: Path) -> None:
    def said(text: str) -> str:
        grid = parse_grid(text, "g")
        return settings_of(grid.file, [CellFolder(tmp_path, cell, "none") for cell in grid.cells])

    assert said('methods = ["dqn"]\npreset = "catch"\nseeds = [0, 1]\n').startswith(
        "settings: preset catch; method: dqn; gamma: 0.99; replay: capacity "
    )
    assert said(
        'methods = ["dqn", "stream-q"]\n[fixed]\nenv.id = "CartPole-v1"\nreplay.eviction = "reservoir"\n'
        "[vary]\nreplay.capacity = [500, 1000]\nlearner.gamma = [0.9, 0.99]\n"
    ) == (
        "settings: no preset: neutral; method: varying; gamma: varying; "
        "replay: capacity varying, eviction reservoir, sampling uniform, ratio 1; network: mlp-128-128-128"
    )


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--lr", "1e-3"], "did you mean --learner.learning-rate?"),
        (["--gamma", "0.9"], "did you mean --learner.gamma?"),
        (["--total-timesteps", "5"], "did you mean --total-steps?"),
        (["--buffer-size", "5"], "did you mean --replay.capacity?"),
        (["--method", "double-dqn"], "did you mean dqn with learner.double = true"),
        (["--seed", "1,000"], "--seed: can't read '1,000'; allowed: INT"),
        (["--seed", "1.5"], "--seed: can't read"),
        (["--learner.reward-bound", "x"], "allowed: FLOAT, or None"),
    ],
)
def test_what_others_would_write_gets_the_right_answer(
    flags: list[str], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError) as caught:
        options(monkeypatch, *flags).run_config()
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"lr": 1e-3}, "lr = 0.001: no such field; did you mean learner.learning_rate? allowed: run, method"),
        ({"gamma": 0.9}, "did you mean learner.gamma?"),
        ({"learner": {"lr": 1e-3}}, "did you mean learner.learning_rate?"),
        ({"replay": {"gamma": 0.9}}, "did you mean learner.gamma?"),
        ({"replay": {"capacty": 9}}, "did you mean capacity?"),
        ({"network": {"hidden": "64,64"}}, "network.hidden = '64,64': must be a list, such as [64, 64]"),
        ({"method": "double-dqn"}, "did you mean dqn with learner.double = true"),
    ],
)
def test_so_it_does_in_python_files_and_grids(tables: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        coop.train(run_dir=tmp_path / "a", **tables)
    assert words in str(caught.value)
    assert resolve({"total_steps": 1e6, "replay": {"capacity": 1e4}}).total_steps == 1_000_000


@pytest.mark.parametrize("hidden", [["64,32"], ["64", "32"], ["=64,32"]])
def test_lists_with_commas(hidden: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    flags = [f"--network.hidden{hidden[0]}"] if hidden[0].startswith("=") else ["--network.hidden", *hidden]
    assert options(monkeypatch, *flags, "--total-steps=1e4").network.hidden == (64, 32)


def test_python_and_commands_say_it_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags: dict[str, Any] = {"env": {"id": "CartPole-v1"}, "total_steps": 60, "network": {"hidden": [4]}, "log": "none"}
    coop.train(run_dir=tmp_path / "a", **flags).wait()
    assert capsys.readouterr().out.startswith("settings: no preset: neutral; ")
    file = f"--config={tmp_path / 'a' / 'config.toml'}"
    done = run_command("coop-lockstep", file, "--run-dir", tmp_path / "b", "--log", "none", check=True)
    assert done.stdout.startswith(f"settings: file {tmp_path / 'a' / 'config.toml'}; method: coop; gamma: 0.99; ")
    again = run_command("coop-lockstep", "--resume", "--run-dir", tmp_path / "b", "--total-steps=80", "--log=none")
    assert "\nsettings: of the resumed run; method: coop; " in again.stdout


@pytest.mark.timeout(600)
def test_a_buffer_of_sixteen_over_processes(tmp_path: Path) -> None:
    flags = ("--replay.capacity", "16", "--total-steps", "300", "--run-dir", tmp_path / "a", "--log", "none")
    done = run_command("coop-local", *flags, timeout=300, check=True)
    assert (
        "settings: preset cartpole; method: coop; gamma: 0.95; replay: capacity 16, eviction reservoir" in done.stdout
    )
    assert coop.load(tmp_path / "a").summary["exit"] == "complete"  # type: ignore[index]
    assert "settings: file" in (tmp_path / "a" / "logs" / "learner.log").read_text()
