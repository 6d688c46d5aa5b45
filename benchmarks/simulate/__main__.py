"""`python -m benchmarks.simulate`: runs seeds; prints what happened in one that fails, and what it takes to fail."""

from __future__ import annotations

import argparse
import sys

from benchmarks.simulate.runner import report_seed, run_many


def main() -> int:
    """Entry point; the exit status is 1 if an invariant was broken."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.simulate", description=__doc__)
    parser.add_argument("--seed", type=int, help="repeat this one, and print its trace")
    parser.add_argument("--seeds", type=int, default=1000, help="how many to run")
    parser.add_argument("--first", type=int, default=0, help="the first one")
    parser.add_argument("--planted", default="", help="with a bug of `planted.py`; 'all': a table of all of them")
    parser.add_argument("--out", default="", help="a JSON file for the figures")
    options = parser.parse_args()
    if options.seed is not None:
        return report_seed(options.seed, options.planted)
    return run_many(options.first, options.seeds, options.planted, options.out)


if __name__ == "__main__":
    sys.exit(main())
