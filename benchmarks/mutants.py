"""Mutation testing of the algorithm: `make mutants`; `mutants.py 'coop.learner.trainer*'` tests a part of it.

mutmut (extra `mutants`) changes one place at a time of the files named in pyproject.toml and runs the tests that reach
it; texts of errors stay. For each file the table gives the mutants made, killed, and killed by their time limit. A
survivor that does what the original does is justified in `benchmarks/equivalent_mutants.toml`, by the line that it
changes; the others are listed.
Exit status 1 where less than 95 % of a file's mutants, the justified ones left out, were killed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mutmut.mutation.diff_apply import get_diff_for_mutant

REQUIRED = 0.95
TIMED_OUT = {36, 24, 152, 255, -24, -9}
KILLED = {1, 3, -11, *TIMED_OUT}  # by a test, by a crash or by its time limit
NOT_RUN = {None, 2}
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.toml")
Change = tuple[str, str]  # a line as it was and as the mutant has it


@dataclass
class Tally:
    """The mutants of one file."""

    made: int = 0
    killed: int = 0
    timed_out: int = 0
    justified: int = 0
    survivors: list[str] = field(default_factory=list)

    @property
    def share(self) -> float:
        """Killed, of those that are not justified."""
        return self.killed / max(1, self.made - self.justified)


def show(name: str) -> Change:
    """The line that a mutant changes, before and after."""
    shown = get_diff_for_mutant(name).splitlines()
    was = [line[1:].strip() for line in shown if line.startswith("-") and not line.startswith("---")]
    now = [line[1:].strip() for line in shown if line.startswith("+") and not line.startswith("+++")]
    return " ".join(was), " ".join(now)


def results() -> Iterator[tuple[str, dict[str, int | None]]]:
    """Each mutated file, and the exit status of the tests by mutant."""
    for meta in sorted(Path("mutants").rglob("*.py.meta")):
        statuses = json.loads(meta.read_text(encoding="utf-8"))["exit_code_by_key"]
        if statuses:
            yield str(meta.relative_to("mutants/coop")).removesuffix(".meta"), statuses


def tally(file: str, statuses: dict[str, int | None], justified: set[Change]) -> Tally:
    """Count the mutants of a file that were run."""
    counted = Tally()
    for name, status in statuses.items():
        if status in NOT_RUN:
            continue
        counted.made += 1
        if status in KILLED:
            counted.killed += 1
            counted.timed_out += status in TIMED_OUT
        elif (change := show(name)) in justified:
            counted.justified += 1
        else:
            counted.survivors.append(f"{file}: {change[0]}  ->  {change[1]}")
    return counted


def main() -> None:
    """Run the mutants and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="mutants to run, such as 'coop.learner.trainer*'; all if not given")
    parser.add_argument("--max-children", default="2", help="processes at a time (default %(default)s)")
    parser.add_argument("--report", action="store_true", help="print the table of what has been run before")
    options = parser.parse_args()
    if not options.report:
        command = ["mutmut", "run", *options.names, "--max-children", options.max_children]
        done = subprocess.run(command, check=False)
        if done.returncode:
            sys.exit(done.returncode)
    entries = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))
    survivors, low = [], []
    print(f"{'file':32}{'made':>6}{'killed':>8}{'by time':>9}{'justified':>11}{'killed of the rest':>20}")
    for file, statuses in results():
        counted = tally(file, statuses, {(entry["was"], entry["now"]) for entry in entries.get(file, [])})
        if counted.made:
            numbers = (
                f"{counted.made:6}{counted.killed:8}{counted.timed_out:9}{counted.justified:11}{counted.share:20.1%}"
            )
            print(f"{file:32}{numbers}")
            survivors += counted.survivors
            low += [file] if counted.share < REQUIRED else []
    print("\n".join(survivors))
    if low:
        sys.exit(f"below {REQUIRED:.0%}: {', '.join(low)}")


if __name__ == "__main__":
    main()
