"""coop beside what people would use instead: `make bench`, or a part of it by `make bench AREAS="table service"`.

Measures the areas in turn and writes benchmarks/results.json, benchmarks/RESULTS.md and a plot of each area as it goes.
`--against FILE` compares with earlier figures, usually the committed ones, instead of writing: it names each ratio that
has fallen out of its earlier range, and then ends with exit status 1.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from pathlib import Path

from bench.areas import AREAS, COMPARISONS, ON_REQUEST
from bench.comparison import SubjectError, compare
from bench.plots import draw
from bench.results import FIGURES, PAGE, Figures, add, fallen, load, none, page, save


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__.split("\n\n")[0])
    parser.add_argument("areas", nargs="*", metavar="AREA", help=f"{', '.join(AREAS)}; all by default but {ON_REQUEST}")
    parser.add_argument("--rounds", type=int, help="turns of each subject; each comparison's own number by default")
    parser.add_argument("--against", type=Path, help="earlier figures; write nothing, name what has fallen")
    options = parser.parse_args()
    if unknown := set(options.areas) - set(AREAS):
        parser.error(f"no area {unknown.pop()!r}; there are {', '.join(AREAS)}")
    old = load(options.against) if options.against else None
    figures: Figures = none() if old else load(FIGURES)
    for comparison in COMPARISONS:
        if comparison.area not in (options.areas or set(AREAS) - {ON_REQUEST}):
            continue
        print(f"{comparison.title} ", end="", file=sys.stderr, flush=True)
        logs = Path(tempfile.mkdtemp(prefix="coop-bench-"))
        try:
            measured = compare(comparison, options.rounds or comparison.rounds, logs)
        except SubjectError as error:
            sys.exit(f"\nmake bench: error: {error}")
        print(file=sys.stderr)
        add(figures, comparison, measured)
        if not old:
            save(figures, FIGURES)
            PAGE.write_text(page(figures))
            draw(figures, comparison.area)
    if old:
        lines = list(fallen(figures, old))
        print("\n".join(lines) or "no ratio has fallen")
        sys.exit(bool(lines))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        main()
    except KeyboardInterrupt:
        print("\nmake bench: stopped; what was measured before stays", file=sys.stderr)
        sys.exit(130)
