"""Mutation testing of the algorithm: `make mutants`; `mutants.py 'coop.learner.trainer*'` tests a part of it.

mutmut (extra `mutants`) makes the mutants: it changes one place at a time of the files that pyproject.toml names; texts
of errors stay. The tests are collected once. A first pass notes which test calls which function and how long it takes;
then each mutant is a fork in which the tests that call its function run, quickest first, until one fails. What has been
killed stays so until its function changes; what has not run and survivors meet the tests at each call, but for those
that are justified.

For each file the table gives the mutants made, killed, and killed by their time limit. A survivor that does what the
original does is justified in `benchmarks/equivalent_mutants.toml`, by the line that it changes, or by the rule that a
tensor's `device` is the same for all where there is no GPU, and that the `strict` of a zip of equal lengths changes
nothing; the others are listed.
Exit status 1 where less than 95 % of a file's mutants, the justified ones left out, were killed.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import json
import os
import re
import signal
import sys
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NoReturn

import pytest
from _pytest.runner import runtestprotocol
from mutmut.__main__ import copy_also_copy_files, copy_src_dir, create_mutants, setup_source_paths
from mutmut.configuration import config
from mutmut.mutation.data import SourceFileMutationData
from mutmut.mutation.diff_apply import get_diff_for_mutant
from mutmut.mutation.trampoline import set_mutant_under_test
from mutmut.state import state
from mutmut.utils.format_utils import mangled_name_from_mutant_name

REQUIRED = 0.95
SURVIVED, KILLED, TIMED_OUT, NO_TEST = 0, 1, 36, 33  # as mutmut notes them
LIMIT = 15.0, 4.0  # seconds that a mutant's tests may take: so many, and so many times what they take without it
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.toml")
# What a mutant may change without a difference, as the text above says.
EQUAL_VALUES = re.compile(r",? *\b(strict|device)=[\w.]*")


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


class Mutants:
    """The mutants of every file, with the status of those that have run."""

    def __init__(self) -> None:
        paths = sorted(Path("mutants").rglob("*.py.meta"))
        self.files = [SourceFileMutationData(path=path.relative_to("mutants").with_suffix("")) for path in paths]
        self.by_name: dict[str, SourceFileMutationData] = {}
        for file in self.files:
            file.meta_path = file.meta_path.absolute()
            file.load()
            self.by_name |= dict.fromkeys(file.exit_code_by_key, file)
        self.entries = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))

    def left(self, patterns: list[str]) -> list[str]:
        """Names of those that no test has killed and nothing justifies, first those that have not run."""
        status = {name: file.exit_code_by_key[name] for name, file in self.by_name.items()}
        left = [
            name
            for name in status
            if status[name] not in (KILLED, TIMED_OUT)
            and (not patterns or any(fnmatch.fnmatch(name, pattern) for pattern in patterns))
            and not (status[name] == SURVIVED and self.justified(name))
        ]
        return sorted(left, key=lambda name: status[name] is not None)

    def change(self, name: str) -> tuple[str, str]:
        """The line that a mutant changes, before and after."""
        shown = get_diff_for_mutant(name, path=self.by_name[name].path).splitlines()
        was = [line[1:].strip() for line in shown if line.startswith("-") and not line.startswith("---")]
        now = [line[1:].strip() for line in shown if line.startswith("+") and not line.startswith("+++")]
        return " ".join(was), " ".join(now)

    def justified(self, name: str) -> bool:
        """Whether a mutant does what the original does."""
        was, now = self.change(name)
        if EQUAL_VALUES.sub("", was) == EQUAL_VALUES.sub("", now).replace(", )", ")"):
            return True
        return any(
            (entry["was"], entry["now"]) == (was, now) for entry in self.entries.get(place(self.by_name[name]), [])
        )

    def tally(self, file: SourceFileMutationData) -> Tally:
        """Count the mutants of a file that were run."""
        counted = Tally()
        for name, status in file.exit_code_by_key.items():
            if status is None:
                continue
            counted.made += 1
            if status in (KILLED, TIMED_OUT):
                counted.killed += 1
                counted.timed_out += status == TIMED_OUT
            elif self.justified(name):
                counted.justified += 1
            else:
                counted.survivors.append("{}: {}  ->  {}".format(name, *self.change(name)))
        return counted

    def note(self, name: str, status: int) -> None:
        """Keep how the tests of a mutant ended."""
        self.by_name[name].exit_code_by_key[name] = status
        self.by_name[name].save()


class Runner:
    """A plugin of pytest that runs the collected tests on mutants, in place of once."""

    def __init__(self, mutants: Mutants, names: list[str], at_once: int) -> None:
        self.mutants, self.names, self.at_once = mutants, names, at_once
        self.items: list[pytest.Item] = []
        self.reached: dict[str, list[int]] = defaultdict(list)  # by function: its tests, quickest first
        self.seconds: list[float] = []

    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        """Run what is left; pytest ends itself where tests can't be collected."""
        if session.testsfailed:
            return None
        import torch._dynamo  # noqa: F401, PLC0415 - PyTorch's optimizers load it at their first step; here, once for all

        self.items = session.items
        self._look()
        running: dict[int, tuple[str, float]] = {}
        started = time.monotonic()
        for count, name in enumerate(self.names, 1):
            while len(running) >= self.at_once:
                self._reap(running)
            tests = self.reached[mangled_name_from_mutant_name(name)]
            if not tests:
                self.mutants.note(name, NO_TEST)
                continue
            limit = LIMIT[0] + LIMIT[1] * sum(self.seconds[test] for test in tests)
            running[_fork(partial(self._try, name, tests))] = name, time.monotonic() + limit
            if count % 50 == 0:
                print(f"{count} of {len(self.names)} mutants, {time.monotonic() - started:.0f} s", file=sys.stderr)
        while running:
            self._reap(running)
        return True

    def _look(self) -> None:
        """Note which test calls which function, and how long it takes."""
        read, write = os.pipe()
        child = _fork(partial(self._note_calls, write))
        os.close(write)
        with os.fdopen(read, encoding="utf-8") as pipe:
            told = pipe.read()
        if os.waitpid(child, 0)[1] or not told:
            pytest.exit(f"without a mutant, a test fails: {told}", returncode=1)
        calls = json.loads(told)
        self.seconds = [seconds for seconds, _ in calls]
        for test in sorted(range(len(calls)), key=self.seconds.__getitem__):
            for function in calls[test][1]:
                self.reached[function].append(test)

    def _note_calls(self, pipe: int) -> NoReturn:
        set_mutant_under_test("stats")
        calls = []
        for test, seconds, failed in self._run(range(len(self.items))):
            if failed:
                os.write(pipe, self.items[test].nodeid.encode())
                os._exit(1)
            calls.append((seconds, sorted(state()._stats)))
            state()._stats.clear()
        with os.fdopen(pipe, "w", encoding="utf-8") as out:
            json.dump(calls, out)
        os._exit(0)

    def _try(self, name: str, tests: list[int]) -> NoReturn:
        set_mutant_under_test(name)
        os._exit(KILLED if any(failed for _, _, failed in self._run(tests)) else SURVIVED)

    def _run(self, tests: Iterable[int]) -> Iterator[tuple[int, float, bool]]:
        """Run tests by their places; yield each with its seconds and whether it failed."""
        order = list(tests)
        for test, following in zip(order, [*order[1:], None], strict=True):
            started = time.monotonic()
            after = None if following is None else self.items[following]
            failed = any(report.failed for report in runtestprotocol(self.items[test], log=False, nextitem=after))
            yield test, time.monotonic() - started, failed

    def _reap(self, running: dict[int, tuple[str, float]]) -> None:
        """Wait until one that runs has ended, or has to."""
        while True:
            for child, (name, end) in running.items():
                late = time.monotonic() > end
                if late:
                    os.killpg(child, signal.SIGKILL)
                ended, code = os.waitpid(child, 0 if late else os.WNOHANG)
                if ended:
                    self.mutants.note(name, TIMED_OUT if late else KILLED if code else SURVIVED)
                    del running[child]
                    return
            time.sleep(0.01)


def _fork(action: Callable[[], NoReturn]) -> int:
    """A child, in a group of its own, that says nothing."""
    child = os.fork()
    if child:
        return child
    try:
        os.setpgid(0, 0)
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        action()
    finally:
        os._exit(KILLED)


def run(patterns: list[str], at_once: int) -> None:
    """Make the mutants, and run the tests on those that are left."""
    set_mutant_under_test("mutant_generation")
    Path("mutants").mkdir(exist_ok=True)
    with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(nowhere):  # what it prints for each file
        copy_src_dir()
        copy_also_copy_files()
        create_mutants(at_once)
    mutants = Mutants()
    names = mutants.left(patterns)
    set_mutant_under_test("")
    setup_source_paths()
    home = Path.cwd()
    os.chdir("mutants")
    arguments = ["--rootdir=.", "-s", *config().pytest_add_cli_args, *config().pytest_add_cli_args_test_selection]
    status = pytest.main(arguments, plugins=[Runner(mutants, names, at_once)])
    os.chdir(home)
    if status:
        sys.exit(int(status))


def place(file: SourceFileMutationData) -> str:
    """A file's path from the top of the repository."""
    return str(Path(file.path).relative_to("coop"))


def main() -> None:
    """Run the mutants and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="mutants to run, such as 'coop.learner.trainer*'; all if not given")
    parser.add_argument("--max-children", type=int, default=2, help="processes at a time (default %(default)s)")
    parser.add_argument("--report", action="store_true", help="print the table of what has been run before")
    options = parser.parse_args()
    if not options.report:
        run(options.names, options.max_children)
    mutants = Mutants()
    survivors, low = [], []
    print(f"{'file':32}{'made':>6}{'killed':>8}{'by time':>9}{'justified':>11}{'killed of the rest':>20}")
    for file in mutants.files:
        counted = mutants.tally(file)
        if counted.made:
            numbers = f"{counted.made:6}{counted.killed:8}{counted.timed_out:9}{counted.justified:11}"
            print(f"{place(file):32}{numbers}{counted.share:20.1%}")
            survivors += counted.survivors
            low += [place(file)] if counted.share < REQUIRED else []
    print("\n".join(survivors))
    if low:
        sys.exit(f"below {REQUIRED:.0%}: {', '.join(low)}")


if __name__ == "__main__":
    main()
