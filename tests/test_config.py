"""Configs: presets resolve, TOML comes back, and what can't be right is refused by field and value."""

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coop.common.errors import UsageError
from coop.common.messaging import wire
from coop.common.settings import schedules
from coop.common.settings.capacity import check_messages
from coop.common.settings.reading import parse_toml
from coop.common.settings.tables import first_difference, load_tables, preset_names, resolve, to_tables, to_toml
from coop.common.types import EnvSpec
from coop.records.run_options import RunOptions, base_config, parse_run


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop"])
def test_presets_resolve_and_come_back_from_toml(preset: str, method: str) -> None:
    resolved = resolve(load_tables(preset, None), method)
    assert resolved.method == method
    assert resolve(tomllib.loads(to_toml(resolved))) == resolved


@pytest.mark.parametrize("size", ["", "-small"])
def test_presets_of_atari_games_differ_in_nothing_but_the_game(size: str) -> None:
    breakout, pong, invaders = (
        to_tables(resolve(load_tables(game + size, None))) for game in ("breakout", "pong", "space-invaders")
    )
    assert (breakout["env"].pop("id"), pong["env"].pop("id"), invaders["env"].pop("id")) == (
        "breakout",
        "pong",
        "space_invaders",
    )
    assert first_difference(breakout, pong) is None
    assert first_difference(breakout, invaders) is None


@pytest.mark.parametrize(
    ("flags", "journal"),
    [
        ([], "off"),
        (["--replay.journal"], "async"),
        (["--replay.journal", "--seed", "3"], "async"),
        (["--replay.journal", "sync"], "sync"),
        (["--replay.journal=sync", "--replay.journal-keep"], "sync"),
        (["--preset", "breakout", "--replay.journal", "off"], "off"),
    ],
)
def test_the_journal_s_flag_needs_no_value(flags: list[str], journal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["coop-local", *flags])
    assert parse_run(RunOptions, "coop-local", "").run_config().replay.journal == journal


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--preset", "breakout", "--learner.batch-size", "60000"], "learner.batch_size = 60000: allowed: at most 75"),
        (["--preset", "breakout", "--actor.segment-steps", "4096"], None),
        (["--network.hidden", "100000", "100000"], "network.hidden = [100000, 100000]: 10,000,"),
        (["--learner.batch-size", "65536"], None),
    ],
)
def test_what_no_message_could_carry_is_refused(
    flags: list[str], words: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["coop-local", *flags])
    config = parse_run(RunOptions, "coop-local", "").run_config()
    pixels = config.env.id != "CartPole-v0"
    spec = EnvSpec("any", (84, 84), "uint8", 4, 4) if pixels else EnvSpec("any", (4,), "float32", 1, 2)
    if words is None:
        check_messages(config, spec)
    else:
        with pytest.raises(UsageError) as caught:
            check_messages(config, spec)
        assert words in str(caught.value)


def test_the_largest_segment_and_batch_that_are_allowed_fit_into_a_message() -> None:
    """Of frames large enough that the payload is what bounds them, and all of them different."""
    spec = EnvSpec("any", (1024, 1024), "uint8", 2, 4)
    most = {}
    for name in ("learner.batch_size", "actor.segment_steps"):
        section, field = name.split(".")
        config = resolve({"learner": {"batch_size": 1}, "actor": {"segment_steps": 1}, section: {field: 1000}})
        with pytest.raises(UsageError, match=name) as caught:
            check_messages(config, spec)
        most[name] = int(re.search(r"at most (\d+)", str(caught.value))[1])  # type: ignore[index]
    batch, steps = most["learner.batch_size"], most["actor.segment_steps"]
    for frames, row_bytes in ((3 * batch, 64 * batch), (2 * steps + 2, 64 * steps)):
        payload = wire.encode("insert", "r", {}, {"frames": np.zeros((frames, 1024, 1024), np.uint8)})
        assert len(payload) + row_bytes <= wire.MAX_PAYLOAD < len(payload) + row_bytes + 6 * 2**20


def test_a_method_table_overrides_the_rest() -> None:
    assert base_config(["--preset", "cartpole-paper", "--method", "g-coop"]).learner.optimizer == "adam"
    assert base_config(["--preset", "cartpole-paper", "--method", "coop"]).learner.optimizer == "rmsprop"


@pytest.mark.parametrize(
    ("flags", "start"),
    [
        ([], 50_000),
        (["--total-steps", "20_000"], 2000),
        (["--total_steps=20000"], 2000),
        (["--total-steps", "1000000"], 50_000),
        (["--total-steps", "9"], 1),
        (["--total-steps", "20000", "--replay.learning-starts", "7000"], 7000),
    ],
)
def test_a_short_run_of_a_long_preset_learns(flags: list[str], start: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["coop-local", "--preset", "breakout", *flags])
    assert parse_run(RunOptions, "coop-local", "").run_config().replay.learning_starts == start


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--preset", "cartpol"], ["preset = 'cartpol': unknown; did you mean cartpole? allowed: breakout, "]),
        (["--replay.capacity", "-5"], ["replay.capacity", "-5", "expected int >= 1"]),
        (["--learner.swap-every", "0"], ["learner.swap_every", "0", "expected int >= 1"]),
        (["--replay.capcity", "5"], ["--replay.capcity: unknown; did you mean --replay.capacity? --help-all lists"]),
        (["--batch-size", "5"], ["--batch-size: unknown; did you mean --learner.batch-size? "]),
        (["--eps=5"], ["--eps=5: unknown; did you mean --learner.eps? "]),
        (["--learner.batchsize=5"], ["did you mean --learner.batch-size? "]),
        (["--learner.nodouble"], ["did you mean --learner.no-double? "]),
        (
            ["--learner.optimizer", "adm"],
            ["--learner.optimizer adm: unknown; did you mean adam? allowed: sgd"],
        ),
        (["--env", "pong"], ["--env: unknown; did you mean --env.id? "]),
        (["preset", "cartpole"], ["preset: unknown; did you mean --preset? "]),
        (["--verison"], ["--verison: unknown; did you mean --version? "]),
        (["--resume=yes"], ["--resume", "yes"]),
        (["--learner.double", "yes"], ["yes: unknown; it follows no flag that takes it"]),
        (["--completion", "bsh"], ["--completion bsh: unknown shell; did you mean bash? allowed: bash, zsh, fish"]),
        (["--completion"], ["--completion: needs a shell; allowed: bash, zsh, fish"]),
        (["--target-return", "x"], ["--target-return: can't read 'x'; allowed: FLOAT"]),
        (["--env.resize", "3"], ["--env.resize: can't read '3'; allowed: INT INT"]),
        (["--seed", "x"], ["--seed", "x"]),
        (["--method", "sarsa"], ["method = 'sarsa': unknown; allowed: dqn, edql, g-coop, coop, medqn"]),
        (["--method", "medqm"], ["method = 'medqm': unknown; did you mean medqn? allowed: dqn"]),
        (["--method", "medqn", "--medqn.epochs", "0"], ["medqn.epochs", "0", "expected int >= 1"]),
        (["--method", "medqn", "--medqn.states", "true"], ["--medqn.states", "uniform, real"]),
        (["--edl.rate", "nan"], ["edl.rate", "nan"]),
        (["--replay.learning-starts", "400", "--replay.capacity", "300"], ["replay.learning_starts", "400", "300"]),
        (
            ["--replay.learning-starts", "4", "--replay.n-step", "5"],
            ["replay.learning_starts = 4", "at least replay.n_step = 5"],
        ),
        (["--actor.segment-steps", "4090", "--replay.n-step", "9"], ["actor.segment_steps = 4090", "at most 4088"]),
        (["--total-steps", "100", "--replay.learning-starts", "128"], ["replay.learning_starts", "128", "100"]),
        (["--total-steps", "0"], ["total_steps", "0", "expected int >= 1"]),
        (["--total-steps", "many"], ["--total-steps", "many"]),
        (["--run", "a/b"], ["run", "a/b"]),
        (["--config", "/no/such.toml"], ["--config", "/no/such.toml"]),
        (["--preset", "cartpole", "--config", "x"], ["--preset", "--config"]),
        (["--seed"], ["--seed", "needs a value"]),
        (["--network.hidden", "3", "x"], ["--network.hidden", "x", "INT"]),
        (
            ["--replay.sampling", "prioritized", "--replay.no-replacement"],
            ["replay.sampling = 'prioritized': allowed: 'uniform' with replay.replacement = False"],
        ),
        (["--replay.journal", "disk"], ["--replay.journal disk: unknown", "off, async, sync"]),
        (["--replay.journal-keep"], ["replay.journal_keep", "'async' or 'sync'"]),
        (["--replay.eviction", "lru"], ["replay.eviction = 'lru': unknown", "reservoir"]),
        (["stray"], ["stray", "unknown"]),
        (["--total-steps", "300", "--replay.learning-starts", "300"], ["total_steps", "300", "at least 301"]),
        (["--total-steps", "1000", "--replay.ratio", "0.0001"], ["total_steps", "1000", "at least 5100"]),
        (["--env.stack=-3"], ["env.stack", "-3", "expected int >= 1"]),
        (["--env.stack", "0"], ["env.stack", "0", "expected int >= 1"]),
        (["--env.stack", "65"], ["env.stack", "65", "64"]),
        (["--env.noop-max", "-1"], ["env.noop_max", "-1"]),
        (["--env.frame-skip", "0"], ["env.frame_skip", "0"]),
        (["--env.max-episode-steps", "-5"], ["env.max_episode_steps", "-5"]),
        (["--env.repeat-action-probability", "1.0"], ["env.repeat_action_probability", "1.0", "expected float < 1.0"]),
        (["--env.id", "x" * 257], ["env.id", "256"]),
        (["--actor.segment-steps", "100000"], ["actor.segment_steps", "100000", "4096"]),
        (["--actor.num-envs", "65537"], ["actor.num_envs", "65536"]),
        (["--actor.max-in-flight", "1025"], ["actor.max_in_flight", "1024"]),
        (["--learner.batch-size", "100000"], ["learner.batch_size", "100000", "65536"]),
        (["--replay.ratio", "1e7"], ["replay.ratio", "1000000"]),
        (["--replay.tolerance", "1e13"], ["replay.tolerance", "1000000000000"]),
        (["--total-steps", "2000000000000"], ["total_steps", "1000000000000"]),
        (["--seed", str(2**63)], ["seed", str(2**63 - 1)]),
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
        ({"replay": {"capcity": 5}}, "replay.capcity = 5: no such field; did you mean capacity? allowed: capacity, "),
        ({"speed": 5}, "speed = 5: no such field; did you mean seed? allowed: run, method"),
        ({"method_settings": 5}, "method_settings = 5: no such field; did you mean methods? allowed: run, method"),
        (
            {"method": "medqn", "medqn": {"lambda": 5}},
            "medqn.lambda = 5: no such field; did you mean lambda_end?",
        ),
        ({"method": "medqn", "medqn": {"lambda_end": "much"}}, "medqn.lambda_end = 'much'"),
        ({"method": "medqn", "medqn": 5}, "medqn = 5: "),
        ({"replay": 5}, "replay = 5"),
        ({"replay": {"capacity": "many"}}, "replay.capacity = 'many': expected int, got str"),
        ({"replay": {"capacity": True}}, "replay.capacity = True: expected int, got bool"),
        ({"network": {"hidden": [8, 0]}}, "network.hidden[1] = 0: expected int >= 1"),
        ({"learner": {"loss": "hubr"}}, "learner.loss = 'hubr': allowed: 'squared', 'mse', 'huber'"),
        ({"learner": {"eps": float("inf")}}, "learner.eps = inf: expected float that is finite"),
        ({"run": "a\n"}, "run = 'a\\n': expected str matching regex"),
    ],
)
def test_files_are_refused_by_field(tables: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError) as caught:
        resolve(tables)
    assert words in str(caught.value)


def test_arguments_of_environments_nest_as_deep_as_files_are_read() -> None:
    deep: list[Any] = [1]
    for _ in range(28):
        deep = [deep]
    config = resolve({"env": {"kwargs": {"a": deep}}})
    assert resolve(parse_toml(to_toml(config))) == config
    with pytest.raises(UsageError, match=r"^env.kwargs = .*: nests more than 29 tables and lists$"):
        resolve({"env": {"kwargs": {"a": [deep]}}})


def test_a_file_that_is_not_toml(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text("a = = 1")
    with pytest.raises(UsageError, match=r"c\.toml"):
        load_tables(None, path)


def test_a_shorter_run_of_a_preset_is_how_the_longer_one_begins() -> None:
    whole = base_config(["--preset", "cartpole"])
    half = base_config(["--preset", "cartpole", "--total-steps", str(whole.total_steps // 2)])
    double = base_config(["--preset", "cartpole", "--total-steps", str(whole.total_steps * 2)])
    for share in (10, 50, 100):
        expected = schedules.learning_rate(whole.learner, share, 200)
        assert schedules.learning_rate(half.learner, share, 100) == pytest.approx(expected)
        assert schedules.learning_rate(double.learner, share, 200) == expected
