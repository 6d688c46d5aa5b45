"""The source of the site: references of settings and flags, lines of quoted code, pictures, and the nav."""

import dataclasses
import importlib
import inspect
import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml

import coop
from coop.common.process.cli import PACKAGE
from coop.common.settings.config import RunConfig
from website import pages, pictures, places, reference
from website.assemble import assembled, refreshed

API = pages.read("docs/api.md")


def test_every_setting_is_in_the_reference() -> None:
    table = reference.settings_reference()
    expected = []
    for field in dataclasses.fields(RunConfig):
        inner = getattr(RunConfig(), field.name)
        if dataclasses.is_dataclass(inner):
            expected += [f"{field.name}.{each.name}" for each in dataclasses.fields(inner)]
        elif field.name not in ("method_settings", "methods"):
            expected.append(field.name)
    assert len(expected) > 70
    assert not [name for name in (*expected, "medqn.epochs", "stream_q.step_size") if f"| `{name}` | " not in table]
    assert "| `replay.n_step` | integer above 0 to 100 | `1` | Rewards that a transition sums" in table
    assert "| `replay.eviction` | `fifo`, `reservoir`, `prioritized` | `fifo` |" in table
    assert "| `learner.double` | `true`, `false` | `false` |" in table


def test_every_command_and_preset_is_in_the_reference() -> None:
    points = entry_points(group="console_scripts")
    assert {point.name for point in points if point.dist and point.dist.name == PACKAGE} == set(reference.COMMANDS)
    table = reference.commands_reference()
    assert not [name for name in reference.COMMANDS if f"### `{name}`" not in table]
    assert "| `--join-timeout FLOAT` | `30.0` | Seconds to search for the learner before giving up. |" in table
    assert "--replay.capacity" not in table
    assert "| `pong-small` | `pong` | 1,000,000 | 10,000 |" in reference.presets_reference()


def test_each_row_of_a_reference_is_one_line() -> None:
    tables = (reference.settings_reference(), reference.commands_reference(), reference.metrics_reference())
    rows = [line for table in tables for line in table.splitlines() if line.startswith("| ") or line.endswith(" |")]
    assert len(rows) > 200
    assert not [row for row in rows if not (row.startswith("| ") and row.endswith(" |"))]


@pytest.mark.parametrize("page", [page for page in pages.page_names() if places.marks(pages.read(page))])
def test_marked_lines_are_quoted(page: str) -> None:
    for file, mark in places.marks(pages.read(page)):
        number, code = places.marked(file, mark)
        lines = (pages.ROOT / file).read_text(encoding="utf-8").splitlines()
        assert (lines[number - 2].strip(), lines[number - 1].strip()) == (mark, code)
        assert f"`{file}`, line {number}: `{code}`" in assembled(page)


def test_every_mark_has_its_page() -> None:
    named = {each for page in pages.page_names() for each in places.marks(pages.read(page))}
    there = {
        (path.relative_to(pages.ROOT).as_posix(), line.strip())
        for top in ("actors", "common", "learner", "replay")
        for path in (pages.ROOT / top).rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if re.fullmatch(r"\s*# \([^)]+\)", line)
    }
    assert there == named


def test_a_mark_that_is_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match=r"learner/agent\.py: 0 lines, not one, are `# \(acting\)`"):
        places.with_lines("`learner/agent.py`: `# (acting)`")


def test_generated_parts_of_pages_are_what_the_code_says() -> None:
    assert "| `replay.capacity` | " in pages.read("docs/configuration.md")
    assert "### `coop-watch`" in pages.read("docs/commands.md")
    stale = [page for page in pages.page_names() if refreshed(page) != pages.read(page)]
    assert not stale, "python -m website.assemble build/docs refreshes them"


@pytest.mark.parametrize("name", pictures.PICTURES)
def test_the_pictures_show_the_committed_data(name: str, tmp_path: Path) -> None:
    assert pictures.draw(name, tmp_path).read_text() == (pictures.FOLDER / f"{name}.svg").read_text()


def test_every_page_is_in_the_nav() -> None:
    nav = yaml.safe_load((pages.ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    assert sorted(re.findall(r"[\w/-]+\.md", str(nav))) == sorted(pages.page_names())


def test_every_public_name_is_documented() -> None:
    shown = re.findall(r"^::: ([\w.]+)\.(\w+)$", API, re.MULTILINE)
    assert sorted(name for module, name in shown if module == "coop") == sorted(coop.__all__)
    for module, name in shown:
        value = getattr(importlib.import_module(module), name)
        members = vars(value) if inspect.isclass(value) else {}
        public = {key: each for key, each in members.items() if not key.startswith("_")}
        documented = [key for key, each in public.items() if getattr(each, "__doc__", "") or key in value.__doc__]
        elsewhere = {field.name for field in dataclasses.fields(RunConfig)} if value is RunConfig else set()
        missing = public.keys() - set(documented) - elsewhere  # tests/test_help.py finds a text of every setting
        assert value.__doc__, name
        assert not missing, name
