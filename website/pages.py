"""The pages of the documentation, and the code blocks in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
LANGUAGES = ("bash", "python", "toml", "yaml", "text")
NOT_RUN = "not run: "
# A fence, its language and its lines; a comment above it is for the tests.
_FENCE = re.compile(r"^(?:<!-- (?P<note>.*) -->\n)?```(?P<language>.*)\n(?P<text>(?:.*\n)*?)```$", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A code block of a page.

    line: of its fence. language: one of `LANGUAGES`; text is output or a drawing, not code.
    note: the comment above it, "not run: REASON" or flags that the tests append to its commands; empty without one.
    """

    page: str
    line: int
    language: str
    text: str
    note: str

    @property
    def code(self) -> bool:
        """Whether it is code, as opposed to output or a drawing."""
        return self.language != "text"

    @property
    def why_not_run(self) -> str:
        """Why the tests do not run it; empty if they do."""
        return self.note.removeprefix(NOT_RUN) if self.note.startswith(NOT_RUN) else ""


def page_names() -> list[str]:
    """The pages, as paths below the repository's root."""
    folders = ("*.md", "docs/*.md", "results/*.md", "results/*/README.md", "results/minatar/plan.md", "benchmarks/*.md")
    return [path.relative_to(ROOT).as_posix() for folder in folders for path in sorted(ROOT.glob(folder))]


def read(page: str) -> str:
    """The Markdown of a page."""
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page: str) -> Iterator[Block]:
    """The code blocks of a page, in order."""
    text = read(page)
    for found in _FENCE.finditer(text):
        line = text.count("\n", 0, found.start("language")) + 1
        yield Block(page, line, found["language"], found["text"], found["note"] or "")


def summary() -> str:
    """How many code blocks there are, and how many of them the tests run."""
    code = [block for page in page_names() for block in blocks(page) if block.code]
    ran = sum(not block.why_not_run for block in code)
    return f"{len(code)} code blocks: {ran} run by make test, {len(code) - ran} not, with the reason in the page"
