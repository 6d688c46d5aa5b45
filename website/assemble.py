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

_GENERATED = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)
_PARTS = {
    "settings": reference.settings_reference,
    "presets": reference.presets_reference,
    "commands": reference.commands_reference,
    "metrics": reference.metrics_reference,
}
_FILES = ("LICENSE", "CITATION.cff", "docs/**/*.svg", "results/**/*.png", "results/**/*.svg", "benchmarks/plots/*.png")


def assembled(page: str) -> str:
    """The Markdown of a page as the site has it."""
    text = _GENERATED.sub(lambda found: _PARTS[found[1]](), pages.read(page))
    return places.with_lines(text)


def main() -> None:
    """Write the folder anew, and say how many code blocks the tests run."""
    folder = Path(sys.argv[1])
    shutil.rmtree(folder, ignore_errors=True)
    for pattern in _FILES:
        for file in pages.ROOT.glob(pattern):
            target = folder / file.relative_to(pages.ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
    for page in pages.page_names():
        target = folder / page
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(assembled(page), encoding="utf-8")
    print(pages.summary())


if __name__ == "__main__":
    main()
