"""Every code block of the documentation runs as it stands, in the order of the page, or says why it does not."""

import json
import re
from pathlib import Path

import pytest
from reader import Reader

from website.pages import blocks, page_names, read

MAX_LINES = 30
PAGES = page_names()
WITH_CODE = [page for page in PAGES if any(block.code and not block.why_not_run for block in blocks(page))]


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Reader:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return Reader(tmp_path)


@pytest.mark.timeout(1200)
@pytest.mark.usefixtures("quick_children")
@pytest.mark.parametrize("page", WITH_CODE)
def test_the_code_of_a_page_runs(page: str, reader: Reader) -> None:
    reader.follow(page)
    assert reader.ran
    outcomes = {path.parent: json.loads(path.read_text())["exit"] for path in reader.folder.rglob("summary.json")}
    whole = ("complete", "interrupted", "stopped by on_episode")
    assert not {path: text for path, text in outcomes.items() if text not in whole}


@pytest.mark.parametrize("page", PAGES)
def test_every_block_is_found_and_has_a_language(page: str) -> None:
    fences = re.findall(r"^ *```.*$", read(page), re.MULTILINE)
    assert len(fences) == 2 * len(list(blocks(page)))
    assert not [block.line for block in blocks(page) if not block.language]


def test_a_module_of_one_s_own_is_short() -> None:
    modules = [block.text for block in blocks("docs/extending.md") if block.text.startswith("# my_")]
    assert len(modules) == 5
    assert max(len([line for line in text.splitlines() if line.strip()]) for text in modules) < MAX_LINES
