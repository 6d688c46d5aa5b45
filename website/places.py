"""Where quoted code is: a page names a file and a line's code, and the site adds the line's number.

A page has "`learner/losses.py`: `the code`"; numbers in a page would be wrong after the next change.
"""

from __future__ import annotations

import re

from website.pages import ROOT

_QUOTE = re.compile(r"`(?P<file>[\w/]+\.py)`: `(?P<code>[^`]+)`")


def line_of(file: str, code: str) -> int:
    """The number of the one line of a file of the repository that holds the code; raises ValueError."""
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    found = [number for number, line in enumerate(lines, 1) if code in line]
    if len(found) != 1:
        raise ValueError(f"{file}: {len(found)} lines, not one, hold `{code}`")
    return found[0]


def quotes(text: str) -> list[tuple[str, str]]:
    """The files and the code that a page quotes from them."""
    return _QUOTE.findall(text)


def with_lines(text: str) -> str:
    """A page with the line's number behind the file of each quote."""
    return _QUOTE.sub(
        lambda found: f"`{found['file']}`, line {line_of(found['file'], found['code'])}: `{found['code']}`", text
    )
