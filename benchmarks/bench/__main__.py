"""coop beside what people would use instead: `make bench`, or a part of it by `make bench AREAS="table service"`.

Measures the areas in turn and writes benchmarks/results.json, benchmarks/RESULTS.md and a plot of each area as it goes.
`--against FILE` compares with earlier figures, usually the committed ones, instead of writing: it names each ratio that
has left its earlier range, and ends with exit status 1 if one of them is worse.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path

from bench.areas import AREAS, COMPARISONS, ON_REQUEST
from bench.comparison import SubjectError, compare
from bench.plots import draw
from bench.results import FIGURES, PAGE, Figures, add, load, moved, none, page, save


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__.split("\n\n")[0])
    parser.add_argument("areas", nargs="*", metavar="AREA", help=f"{', '.join(AREAS)}; all by default but {ON_REQUEST}")
    parser.add_argument("--rounds", type=int, help="turns of each subject; each comparison's own number by default")
    parser.add_argument("--against", type=Path, help="earlier figures; write nothing, name what has moved")
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
        changes = list(moved(figures, old))
        for which, name in ((1, "better"), (-1, "worse")):
            for line in (line for way, line in changes if way == which):
                print(f"{name}: {line}")
        ways = Counter(way for way, _ in changes)
        print(f"of {len(changes)} ratios {ways[0]} agree within their ranges, {ways[1]} are better, {ways[-1]} worse")
        sys.exit(ways[-1] > 0)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        main()
    except KeyboardInterrupt:
        print("\nmake bench: stopped", file=sys.stderr)
        sys.exit(130)
