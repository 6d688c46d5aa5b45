"""Assembles the site's source in a folder: pages, figures, and what is generated.

The folder has the repository's layout, so that links between pages hold in both.

    python -m website.assemble FOLDER
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

from website import pages, places, reference

_GENERATED = re.compile(r"^<!-- generated: (\w+) -->$.*?^<!-- end -->$", re.MULTILINE | re.DOTALL)
_PARTS = {
    "settings": reference.settings_reference,
    "presets": reference.presets_reference,
    "commands": reference.commands_reference,
    "metrics": reference.metrics_reference,
    "names": reference.names_reference,
}
_PICTURES = ("docs/pictures/*", "results/**/*.png", "results/**/*.svg", "benchmarks/plots/*.png")


def refreshed(page: str) -> str:
    """The Markdown of a page with its generated parts, between two comments, as they are now."""

    def now(part: re.Match[str]) -> str:
        return f"<!-- generated: {part[1]} -->\n\n{_PARTS[part[1]]()}\n<!-- end -->"

    return _GENERATED.sub(now, pages.read(page))


def assembled(page: str) -> str:
    """The Markdown of a page as the site has it."""
    return places.with_lines(refreshed(page))


def main() -> None:
    """Refresh what is generated in the pages, write the folder anew, and say how many code blocks the tests run."""
    folder = Path(sys.argv[1])
    shutil.rmtree(folder, ignore_errors=True)
    for pattern in ("LICENSE", "CITATION.cff", *_PICTURES):
        for file in pages.ROOT.glob(pattern):
            target = folder / file.relative_to(pages.ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
    for page in pages.page_names():
        target = folder / page
        target.parent.mkdir(parents=True, exist_ok=True)
        (pages.ROOT / page).write_text(refreshed(page), encoding="utf-8")
        target.write_text(assembled(page), encoding="utf-8")
    print(pages.summary())


if __name__ == "__main__":
    main()
