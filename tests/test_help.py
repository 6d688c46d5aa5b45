"""What a stranger asks a command first: its help on two screens, every flag with a text, its version, completion."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from coop.common.process.cli import EXIT_STATUSES, PACKAGE
from coop.common.settings.methods import METHODS
from coop.records.run_options import COMMON, RunOptions, parse_run
from website.reference import COMMANDS as OPTIONS

ROOT = Path(__file__).parents[1]
RUNS = [name for name, kind in OPTIONS.items() if issubclass(kind, RunOptions)]
ASK = """
import io, json, sys
from contextlib import redirect_stdout
from importlib.metadata import entry_points

pages = {}
for name in sys.argv[1:]:
    (command,) = entry_points(group="console_scripts", name=name)
    for flags in ("--help", "--help-all", "--version", "--completion bash"):
        sys.argv = [name, *flags.split()]
        with redirect_stdout(io.StringIO()) as page:
            try:
                command.load()()
            except SystemExit as end:
                pages[name + " " + flags] = page.getvalue() if end.code == 0 else None
pages["torch"] = "torch" in sys.modules
print(json.dumps(pages))
"""


@pytest.fixture(scope="module")
def pages() -> dict[str, Any]:
    """What each command prints, by its command line, on 80 columns; None if it fails."""
    command = [sys.executable, "-c", ASK, *OPTIONS]
    done = subprocess.run(command, env={**os.environ, "COLUMNS": "80"}, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)  # type: ignore[no-any-return]


def test_every_command_is_tested() -> None:
    points = entry_points(group="console_scripts")
    assert {point.name for point in points if point.dist and point.dist.name == PACKAGE} == set(OPTIONS)


@pytest.mark.parametrize("name", OPTIONS)
def test_the_help_fits_two_screens(name: str, pages: dict[str, Any]) -> None:
    lines = pages[f"{name} --help"].splitlines()
    assert lines[0].startswith(f"usage: {name} ")
    assert len(lines) < 48, "a line is the prompt's"
    assert max(map(len, lines)) <= 80
    assert "--help-all" in lines[-1]


@pytest.mark.parametrize(
    ("name", "usage", "entry"),
    [
        ("coop-eval", "[RUN_DIR ...] [FLAGS]", "RUN_DIR"),
        ("coop-report", "RUNS [FLAGS]", "RUNS"),
        ("coop-lockstep", "[FLAGS]", "--preset"),
    ],
)
def test_what_needs_no_flag_comes_first(name: str, usage: str, entry: str, pages: dict[str, Any]) -> None:
    lines = pages[f"{name} --help"].splitlines()
    assert lines[0] == f"usage: {name} {usage}"
    assert next(iter(entries("\n".join(lines)))) == entry


@pytest.mark.parametrize(
    ("name", "flag"),
    [
        ("coop-local", "--web [HOST:]PORT"),
        ("coop-learner", "--prometheus [HOST:]PORT"),
        ("coop-actor", "--health [HOST:]PORT"),
        ("coop-eval", "--networks {1,2,mean} ..."),
    ],
)
def test_the_help_says_how_a_value_is_written(name: str, flag: str, pages: dict[str, Any]) -> None:
    assert f"\n  {flag} " in pages[f"{name} --help-all"].replace("\n" + " " * 28, " ")


def test_no_answer_waits_for_torch(pages: dict[str, Any]) -> None:
    assert pages["torch"] is False


def entries(page: str) -> dict[str, str]:
    """The flags and arguments of a page, with their texts but without the defaults."""
    found: dict[str, str] = {}
    for line in page.splitlines():
        if entry := re.match(r"  (--[\w.-]+|[A-Z_]+)\b.*?(?:  +(.*))?$", line):
            last, text = entry.groups(default="")
            found[last] = text
        elif line.startswith(" " * 28):
            found[last] += f" {line.strip()}"
    return {name: re.sub(r" *\((default: [^()]*|required)\)$", "", text).strip() for name, text in found.items()}


def settings(kind: type[Any], prefix: str = "--") -> Iterator[str]:
    """The flags that a dataclass and those in it should have."""
    hints = get_type_hints(kind)
    for field in dataclasses.fields(kind):
        name = f"{prefix}{field.name.replace('_', '-')}"
        if dataclasses.is_dataclass(inner := hints[field.name]):
            assert isinstance(inner, type)
            yield from settings(inner, f"{name}.")
        elif name not in ("--method-settings", "--methods"):
            yield name


@pytest.mark.parametrize("name", OPTIONS)
def test_the_full_help_has_a_line_and_a_text_for_every_setting(name: str, pages: dict[str, Any]) -> None:
    shown = entries(pages[f"{name} --help-all"])
    expected = {flag.removeprefix("--").replace("-", "_").upper(): flag for flag in settings(OPTIONS[name])}
    missing = [flag for argument, flag in expected.items() if not (shown.get(flag) or shown.get(argument))]
    assert not missing
    assert not [flag for flag, text in shown.items() if not text]
    assert max(map(len, pages[f"{name} --help-all"].splitlines())) <= 80


@pytest.mark.parametrize("name", RUNS)
def test_the_full_help_of_a_run_has_the_methods_and_their_settings(name: str, pages: dict[str, Any]) -> None:
    shown = entries(pages[f"{name} --help-all"])
    methods = [METHODS.get(method) for method in METHODS.names()]
    flags = [flag for each in methods if each.settings for flag in settings(each.settings, f"--{each.name}.")]
    assert flags
    assert not [flag for flag in flags if not shown.get(flag)]
    assert not [each.name for each in methods if f"{each.name}: {each.summary}" not in shown["--method"]]
    assert "cartpole-paper" in shown["--preset"]


@pytest.mark.parametrize("name", RUNS)
def test_the_short_help_of_a_run_has_the_common_flags(name: str, pages: dict[str, Any]) -> None:
    shown = entries(pages[f"{name} --help"])
    assert list(shown) == [flag for flag in COMMON if flag in entries(pages[f"{name} --help-all"])]
    assert all(shown.values())


def test_the_help_shows_the_defaults_of_the_preset_that_is_given(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["coop-lockstep", "--preset", "breakout", "-h"])
    with pytest.raises(SystemExit) as end:
        parse_run(RunOptions, "coop-lockstep", "", lockstep=True)
    assert end.value.code == 0
    assert "(default: breakout)" in capsys.readouterr().out


def test_every_common_flag_is_a_runs() -> None:
    assert set(COMMON) <= {flag for name in RUNS for flag in settings(OPTIONS[name])}


@pytest.mark.parametrize("name", OPTIONS)
def test_the_full_help_has_the_exit_statuses(name: str, pages: dict[str, Any]) -> None:
    words = " ".join(pages[f"{name} --help-all"].split())
    assert not [text for status, text in EXIT_STATUSES if f"{status} {text}" not in words]


def test_the_documentation_has_the_commands_and_the_exit_statuses() -> None:
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    assert not [row for row in EXIT_STATUSES if f"| {row[0]} | {row[1]} |" not in page]
    assert not [name for name in OPTIONS if f"`{name}`" not in page]


@pytest.mark.parametrize("name", OPTIONS)
def test_the_version_is_the_packages(name: str, pages: dict[str, Any]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", project["version"])
    assert pages[f"{name} --version"] == f"{name} {project['version']}\n"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--replay.cap", "--replay.capacity"),
        ("--preset minatar-s", "minatar-seaquest minatar-space-invaders"),
        ("--replay.journal s", "sync"),
        ("--learner.loss h", "huber"),
    ],
)
def test_bash_completes_flags_and_values(words: str, expected: str, pages: dict[str, Any], tmp_path: Path) -> None:
    script = tmp_path / "completion.bash"
    script.write_text(pages["coop-lockstep --completion bash"])
    typed = ["coop-lockstep", *words.split()]
    ask = f"source {script}; COMP_WORDS=({' '.join(typed)}); COMP_CWORD={len(typed) - 1}; _tyro_coop_lockstep"
    command = ["bash", "-c", f'{ask}; echo "${{COMPREPLY[@]}}"']
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (f"{expected}\n", "")


@pytest.mark.parametrize("name", OPTIONS)
def test_every_command_completes(name: str, pages: dict[str, Any]) -> None:
    assert f"complete -F _tyro_{name.replace('-', '_')} {name}\n" in pages[f"{name} --completion bash"]
