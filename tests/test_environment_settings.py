"""Settings of environments of one's own: tables on the command line, in files and in messages; earlier configs."""

import tomllib
from typing import Any

import pytest

from coop.common.errors import UsageError
from coop.common.messaging import wire
from coop.common.messaging.messages.control import JoinReply
from coop.common.process.cli import parse
from coop.common.settings.config import RunConfig
from coop.common.settings.environment import EnvSettings
from coop.common.settings.resuming import check_resumed
from coop.common.settings.tables import resolve, to_tables, to_toml
from coop.common.types import EnvSpec
from coop.records.run_options import RunOptions, base_config, parse_run

TABLE = {"side": 12, "kind": "x y", "deep": {"rate": 0.5, "on": True}, "walls": [[1, 2], [3]], "none": {}}
INLINE = "{side = 12, kind = 'x y', deep = {rate = 0.5, on = true}, walls = [[1, 2], [3]], none = {}}"


def parsed(monkeypatch: pytest.MonkeyPatch, *flags: str) -> RunConfig:
    monkeypatch.setattr("sys.argv", ["coop-lockstep", *flags])
    return parse_run(RunOptions, "coop-lockstep", "", lockstep=True).run_config()


def test_keyword_arguments_on_the_command_line_in_files_and_in_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    config = parsed(monkeypatch, "--env.id", "my_envs:Room-v0", "--env.kwargs", INLINE, "--env.resize", "8", "9")
    assert (config.env.kwargs, config.env.resize) == (TABLE, (8, 9))
    assert hash(config) == hash(resolve(tomllib.loads(to_toml(config))))
    assert resolve(tomllib.loads(to_toml(config))) == config
    reply = JoinReply(config, EnvSpec("x", (2, 2, 3), "bool", 2, 2), "0", 0, [], 1, 0)
    received = JoinReply.decode(wire.decode(bytes(reply.encode("r"))))
    assert (received.config, received.spec) == (config, reply.spec)


def test_a_given_table_replaces_the_one_of_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    file = tmp_path / "config.toml"
    file.write_text("[env]\nid = 'my_envs:Room-v0'\nkwargs = {side = 3, kind = 'planes'}\n")
    assert parsed(monkeypatch, "--config", str(file)).env.kwargs == {"side": 3, "kind": "planes"}
    assert parsed(monkeypatch, "--config", str(file), "--env.kwargs", "{side = 5}").env.kwargs == {"side": 5}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("side=12", "--env.kwargs: 'side=12' is no inline TOML table"),
        ("{side = }", "--env.kwargs: '{side = }' is no inline TOML table"),
        ("3", "--env.kwargs: '3' is no inline TOML table"),
        ("{}\nother = 3", "is no inline TOML table"),
        ("{at = 2026-01-01}", "env.kwargs = .*: allowed: strings, booleans, finite numbers, lists and tables"),
        ("{x = nan}", "env.kwargs = .*nan: allowed: strings"),
        ("{x = 9223372036854775808}", "env.kwargs = .*9223372036854775808: allowed: strings"),
        ("{x = '" + 70_000 * "x" + "'}", "env.kwargs = .* bytes; allowed: at most 65,536"),
    ],
)
def test_what_is_no_table_of_plain_values_is_refused(text: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match=words):
        parsed(monkeypatch, "--env.id", "my_envs:Room-v0", "--env.kwargs", text)


def test_help_shows_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse(EnvSettings, "x", "", EnvSettings(kwargs={"side": 12, "deep": {"on": True}}), ["--help"])
    assert "{ side = 12, deep = { on = true } }" in " ".join(capsys.readouterr().out.split())


def test_an_id_names_a_module_or_a_game() -> None:
    cases = {
        "breakout": (True, None),
        "ALE/Pong-v5": (True, None),
        "CartPole-v1": (False, None),
        "coop/Catch-v0": (False, None),
        "my_envs:Room-v0": (False, "my_envs"),
        "my.envs:Room": (False, "my.envs"),
        "my_envs:space/Room-v0": (False, "my_envs"),
    }
    assert {name: (EnvSettings(id=name).atari, EnvSettings(id=name).module) for name in cases} == cases
    assert RunConfig(env=EnvSettings(id="my.envs:Room")).imports == {"env.id": "my.envs:Room"}


def test_a_stack_of_vectors_is_kept_today() -> None:
    assert resolve({"env": {"id": "CartPole-v0", "stack": 4}}).env.stack == 4
    assert resolve(to_tables(RunConfig(env=EnvSettings(stack=4)))).env.stack == 4


@pytest.mark.parametrize(("preset", "stack"), [("catch", 4), ("pong", 4), ("pong-small", 4), ("cartpole", 1)])
def test_presets_say_how_many_frames_are_stacked(preset: str, stack: int) -> None:
    assert base_config(["--preset", preset]).env.stack == stack


def test_other_keyword_arguments_are_another_run(tmp_path: Any) -> None:
    mine, theirs = (RunConfig(env=EnvSettings(kwargs={"side": side})) for side in (3, 4))
    with pytest.raises(UsageError, match=r"env\.kwargs\.side = 3, but 4"):
        check_resumed(mine, theirs, tmp_path / "config.toml")
