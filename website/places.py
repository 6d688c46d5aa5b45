"""Where the code is that a page speaks of: a comment marks it, and the site adds the line's number and its code.

A page has "`learner/losses.py`: `# (td error)`", and that file a line `# (td error)` above the code.
"""

from __future__ import annotations

import re

from website.pages import ROOT

_MARK = re.compile(r"`(?P<file>[\w/]+\.py)`: `(?P<mark># \([^`]+\))`")


def marked(file: str, mark: str) -> tuple[int, str]:
    """The number of the line below the one mark in a file of the repository, and its code; raises ValueError."""
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    found = [number for number, line in enumerate(lines, 1) if line.strip() == mark]
    if len(found) != 1:
        raise ValueError(f"{file}: {len(found)} lines, not one, are `{mark}`")
    return found[0] + 1, lines[found[0]].strip()


def marks(text: str) -> list[tuple[str, str]]:
    """The files and marks that a page names."""
    return _MARK.findall(text)


def with_lines(text: str) -> str:
    """A page with number and code of the line in place of each mark."""
    return _MARK.sub(lambda found: "`{}`, line {}: `{}`".format(found["file"], *marked(*found.groups())), text)
