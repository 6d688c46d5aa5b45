"""Settings that methods differ in survive in a resolved config; flags without an effect are named."""

import tomllib
from pathlib import Path

import pytest

from coop.common.errors import RunError, UsageError
from coop.common.settings.config import RunConfig, value_of
from coop.common.settings.medqn import MedqnSettings
from coop.common.settings.resuming import check_resumed
from coop.common.settings.tables import load_tables, preset_names, resolve, to_tables, to_toml, validated
from coop.records.run_options import RunOptions, base_config, parse_run

METHODS = ["dqn", "edql", "g-coop", "coop", "medqn", "stream-q"]


def parsed(flags: list[str], monkeypatch: pytest.MonkeyPatch, *, lockstep: bool = False) -> RunConfig:
    monkeypatch.setattr("sys.argv", ["coop-local", *flags])
    return parse_run(RunOptions, "coop-local", "", lockstep=lockstep).run_config()


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("first", METHODS)
def test_the_config_of_a_run_of_one_method_gives_that_of_another(preset: str, first: str) -> None:
    written = tomllib.loads(to_toml(resolve(load_tables(preset, None), first)))
    for second in METHODS:
        again = resolve(written, second)
        assert again == resolve(load_tables(preset, None), second)
        assert resolve(tomllib.loads(to_toml(again)), first) == resolve(written)


def test_a_flag_of_the_first_run_stays_unless_the_second_method_has_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = parsed(["--preset=cartpole-paper", "--learner.optimizer=sgd", "--learner.gamma=0.9"], monkeypatch)
    file = tmp_path / "config.toml"
    file.write_text(to_toml(config))
    assert parsed([f"--config={file}"], monkeypatch) == config
    for method, optimizer in (("coop", "sgd"), ("dqn", "sgd"), ("g-coop", "adam")):
        again = parsed([f"--config={file}", "--method", method], monkeypatch).learner
        assert (again.optimizer, again.gamma) == (optimizer, 0.9)


def test_a_config_that_does_not_know_other_methods_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables = to_tables(RunConfig())
    assert tables.pop("methods") == {}
    file = tmp_path / "old.toml"
    file.write_text('method = "coop"\n[learner]\noptimizer = "sgd"\n')
    assert base_config([f"--config={file}", "--method", "dqn"]).learner.optimizer == "sgd"
    assert capsys.readouterr().err == (f"warning: {file} has no settings for single methods: dqn gets those of coop\n")
    file.write_text(to_toml(RunConfig()))
    base_config([f"--config={file}", "--method", "dqn"])
    base_config([f"--config={file}"])
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("methods = 5", "methods: must hold one table for each method"),
        ("[methods]\ndqn = 5", "methods: must hold one table for each method"),
        ("[methods.dqnn.learner]\ngamma = 0.5", "methods.dqnn: no such method; allowed: dqn, edql"),
        ("[methods.coop]\nlearner = 5\n[learner]\ngamma = 0.5", "learner = 5: must be a table"),
    ],
)
def test_tables_of_methods_are_checked(text: str, words: str) -> None:
    with pytest.raises(UsageError) as caught:
        resolve(tomllib.loads(text))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("flags", "names"),
    [
        (["--method", "dqn", "--edl.rate", "0.1"], ["edl.rate"]),
        (["--method", "g-coop", "--edl.noise=normal", "--edl.decay", "1"], ["edl.decay", "edl.noise"]),
        (["--method", "coop", "--edl.rate", "0.1", "--edl.decay-every", "5"], []),
        (["--edl.feedback", "random", "--edl.rate", "1"], ["edl.rate"]),
        (["--edl.rate", "0", "--edl.noise", "normal"], ["edl.noise"]),
        (["--edl.decay", "1", "--edl.decay-every", "5"], ["edl.decay-every"]),
        (["--learner.no-tf32"], ["learner.tf32"]),
        (["--preset", "catch", "--network.hidden", "3", "4"], ["network.hidden"]),
        (["--method", "dqn", "--learner.target-update-every", "5"], []),
        (
            ["--method", "dqn", "--learner.target-update-every", "5", "--learner.swap-every", "5"],
            ["learner.swap-every"],
        ),
        (["--learner.target-update-every", "5"], ["learner.target-update-every"]),
        (["--method", "edql", "--learner.reset-role-at-episode"], ["learner.reset-role-at-episode"]),
        (["--learner.optimizer", "rmsprop", "--learner.beta1", "0.8", "--learner.alpha", "0.8"], ["learner.beta1"]),
        (["--method", "g-coop", "--learner.beta2", "0.8", "--learner.alpha", "0.8"], ["learner.alpha"]),
        (["--learner.optimizer", "sgd", "--learner.eps", "1"], ["learner.eps"]),
        (["--learner.gradient-alpha", "0.5"], ["learner.gradient-alpha"]),
        (["--replay.eviction", "prioritized", "--replay.priority-exponent", "1"], ["replay.priority-exponent"]),
        (["--replay.sampling", "prioritized", "--replay.importance-exponent", "1"], []),
        (
            ["--actor.epsilon-start", "0.1", "--actor.epsilon-final", "0.1", "--actor.epsilon-steps", "9"],
            ["actor.epsilon-steps"],
        ),
        (["--env.episodic-life", "--env.clip-rewards"], ["env.episodic-life"]),
        (["--preset", "breakout", "--env.no-episodic-life"], []),
        (["--env.no-episodic-life"], ["env.episodic-life"]),
        (["--method", "medqn", "--medqn.epochs", "2", "--medqn.states", "real"], []),
        (["--method", "dqn", "--medqn.epochs", "2"], ["medqn.epochs"]),
        (["--method", "stream-q", "--stream-q.trace-decay", "0.9", "--learner.gamma", "0.9", "--seed", "3"], []),
        (
            ["--method", "stream-q", "--replay.capacity", "900", "--learner.double", "--actor.epsilon-final", "0"],
            ["actor.epsilon-final", "learner.double", "replay.capacity"],
        ),
        (
            ["--method", "stream-q", "--stream-q.epsilon-start", "0.01", "--stream-q.epsilon-share", "0.5"],
            ["stream-q.epsilon-share"],
        ),
        (["--stream-q.trace-decay", "0.9"], ["stream-q.trace-decay"]),
        (
            ["--method", "medqn", "--medqn.lambda-start", "0", "--medqn.lambda-end", "0", "--medqn.states", "real"],
            ["medqn.states"],
        ),
    ],
)
def test_flags_without_an_effect_are_named(
    flags: list[str], names: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parsed(flags, monkeypatch)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" has no effect: ")[0] for line in lines] == [f"warning: --{name}" for name in names]


def test_the_reason_is_said_and_files_may_hold_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = parsed(["--method", "dqn", "--edl.rate", "0.1"], monkeypatch)
    assert capsys.readouterr().err == "warning: --edl.rate has no effect: dqn takes the ordinary gradient\n"
    file = tmp_path / "config.toml"
    file.write_text(to_toml(config))
    assert parsed([f"--config={file}"], monkeypatch) == config
    assert capsys.readouterr().err == ""


def test_a_methods_own_settings_are_kept_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = ["--medqn.states", "real", "--medqn.lambda-end=2", "--medqn.epochs", "3"]
    config = parsed(["--method", "medqn", *flags], monkeypatch)
    assert config.method_settings == MedqnSettings("real", 0.01, 2.0, 3)
    assert to_tables(config)["medqn"] == {"states": "real", "lambda_start": 0.01, "lambda_end": 2.0, "epochs": 3}
    file = tmp_path / "config.toml"
    file.write_text(to_toml(config))
    assert parsed([f"--config={file}"], monkeypatch) == config
    assert parsed([f"--config={file}", "--medqn.epochs", "4"], monkeypatch).method_settings == MedqnSettings(
        "real", 0.01, 2.0, 4
    )
    other = parsed([f"--config={file}", "--method", "dqn"], monkeypatch)
    assert other.method_settings is None
    assert validated(to_tables(config)) == config, "what joining roles receive"
    assert "medqn" not in to_tables(other)
    file.write_text(to_toml(other))
    assert parsed([f"--config={file}", "--method", "medqn"], monkeypatch) == config


def test_a_presets_table_of_one_method_overrides_its_own_settings() -> None:
    tables = {"medqn": {"epochs": 2, "states": "real"}, "methods": {"medqn": {"medqn": {"epochs": 3}, "seed": 7}}}
    config = resolve(tables, "medqn")
    assert (config.method_settings, config.seed) == (MedqnSettings("real", epochs=3), 7)
    again = resolve(to_tables(resolve(to_tables(resolve(tables, "dqn")), "coop")), "medqn")
    assert again == config


def test_values_by_name_are_those_of_the_runs_method() -> None:
    names = ["total_steps", "replay.capacity", "medqn.epochs", "learner.target_update_every"]
    medqn, dqn = (resolve({"medqn": {"epochs": 2}}, method) for method in ("medqn", "dqn"))
    assert [value_of(medqn, name) for name in names] == [50_000, 5000, 2, None]
    assert [value_of(dqn, name) for name in names] == [50_000, 5000, None, None]


def test_what_only_processes_have_means_nothing_in_lockstep(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--replay.tolerance", "9", "--learner.prefetch", "2"]
    parsed(flags, monkeypatch)
    assert capsys.readouterr().err == ""
    parsed(flags, monkeypatch, lockstep=True)
    assert capsys.readouterr().err == (
        "warning: --learner.prefetch has no effect: a lockstep run is one process\n"
        "warning: --replay.tolerance has no effect: a lockstep run is one process\n"
    )


SAVED = validated({"total_steps": 1000, "total_episodes": 7, "replay": {"capacity": 500}})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, None),
        ({"total_steps": 2000}, None),
        ({"total_steps": 999}, "--resume: total_steps = 999, but 1000 (it may only grow) in c.toml, which goes on"),
        ({"total_episodes": 8}, None),
        ({"total_episodes": 0}, None),
        ({"total_episodes": 6}, "total_episodes = 6, but 7"),
        ({"total_updates": 6}, "total_updates = 6, but 0"),
        ({"target_return": 5.0, "checkpoint_every": 3}, None),
        ({"methods": {"dqn": {"learner": {"gamma": 0.5}}}}, None),
        (
            {"replay": {"capacity": 600}, "learner": {"gamma": 0.5}},
            "learner.gamma = 0.5, but 0.99; replay.capacity = 600, but 500 in c.toml",
        ),
        ({"learner": {"learning_rate": 0.5}, "total_steps": 2000}, "--resume: learner.learning_rate = 0.5, but 0.001"),
        ({"learner": {"target_update_every": 3}}, "learner.target_update_every = 3, but None"),
    ],
)
def test_what_a_run_that_goes_on_may_be_given_anew(change: dict[str, object], words: str | None) -> None:
    config = resolve(base_tables_with(change))
    if words is None:
        check_resumed(config, SAVED, Path("c.toml"))
    else:
        with pytest.raises(UsageError) as caught:
            check_resumed(config, SAVED, Path("c.toml"))
        assert words in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 3, "replay": {"capacity": 600}}, "another run's, whose seed is 0; here it is 3"),
        ({"method": "dqn"}, "another run's, whose method is coop; here it is dqn"),
        ({"env": {"id": "CartPole-v1"}}, "another run's, whose env.id is CartPole-v0; here it is CartPole-v1"),
        ({"run": "other"}, "another run's, whose run is coop; here it is other"),
    ],
)
def test_another_run_is_no_run_to_go_on_with(change: dict[str, object], words: str) -> None:
    with pytest.raises(RunError, match=words):
        check_resumed(resolve(base_tables_with(change)), SAVED, Path("runs/a/config.toml"))


def base_tables_with(change: dict[str, object]) -> dict[str, object]:
    tables = to_tables(SAVED)
    for name, value in change.items():
        tables[name] = {**tables[name], **value} if isinstance(value, dict) else value
    return tables
