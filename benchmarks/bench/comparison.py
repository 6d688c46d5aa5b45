"""Subjects that do the same work take turns: each is a process of its own, which waits while the others have theirs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

ROOT = Path(__file__).parents[2]
SUBJECTS = Path(__file__).parent / "subjects"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
GRACE = 60.0  # seconds for a subject to end after its last turn

# By round, the value of each measure.
Rounds = dict[str, list[float]]


class SubjectError(Exception):
    """A subject ended before its turns did."""


@dataclass(frozen=True)
class Subject:
    """One of those compared.

    Attributes:
        script: of `subjects/`, without its suffix.
        arguments: of the script.
        venv: in .bench/, that holds its libraries.
        cores: it may run on; all of them if 0.
    """

    script: str
    arguments: tuple[str, ...] = ()
    venv: str = "bench"
    cores: int = 1


@dataclass(frozen=True)
class Comparison:
    """The same work done by several subjects.

    Attributes:
        area: which "make bench" measures by itself.
        title: unique.
        subjects: by name.
        reference: the subject whose figures count as 1.
        rounds: turns of each.
        seconds: that a turn lasts at least; 0 where a turn is a whole task.
        abreast: as many rounds run at once as there are cores, each on its own; those of subjects that use several
            cores follow one after another.
    """

    area: str
    title: str
    subjects: dict[str, Subject]
    reference: str
    rounds: int = 5
    seconds: float = 2.0
    abreast: bool = False


@dataclass(frozen=True)
class Lane:
    """The rounds `first`, `first` + `step` and so on, on core number `first`."""

    first: int = 0
    step: int = 1


class Running:
    """A subject's process; ROUNDS in its environment holds the numbers of its lane."""

    def __init__(self, name: str, subject: Subject, lane: Lane, log: Path) -> None:
        self.name = name
        self.alone = subject.cores == 1
        python = ROOT / ".bench" / subject.venv / "bin" / "python"
        path = f"{SUBJECTS.parent}:{SUBJECTS.parents[1]}"
        pin = ["taskset", "-c", f"{lane.first}-{lane.first + subject.cores - 1}"] if subject.cores else []
        self._log = log
        with log.open("w") as file:
            self._process = subprocess.Popen(
                [*pin, str(python), str(SUBJECTS / f"{subject.script}.py"), *subject.arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
                env={
                    **os.environ,
                    **ONE_THREAD,
                    "PYTHONPATH": path,
                    "PYTHONWARNINGS": "ignore",
                    "ROUNDS": f"{lane.first} {lane.step}",
                },
            )
        self._answer()

    def turn(self, seconds: float) -> dict[str, float]:
        """One turn's measures."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{seconds}\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self._ended() from None
        return self._answer()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._process.communicate(timeout=GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()

    def _answer(self) -> dict[str, float]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):  # a library may print something as it is imported
                answer: dict[str, float] = json.loads(line)
                return answer
        raise self._ended()

    def _ended(self) -> SubjectError:
        self._process.communicate()
        status = self._process.returncode
        words = self._log.read_text(errors="replace").strip().splitlines()[-1:] or ["it said nothing"]
        return SubjectError(f"{self.name} ended (exit status {status}): {words[0]}; see {self._log}")


@contextmanager
def started(comparison: Comparison, lane: Lane, logs: Path) -> Iterator[list[Running]]:
    """The subjects of a comparison that take turns in a lane, ready for their first one.

    The first lane has those that use several cores, too; they take the turns of all lanes.
    """
    with ExitStack() as stack:
        found = []
        for name, subject in comparison.subjects.items():
            log = logs / f"{comparison.title}-{name}-{lane.first}.log".replace(" ", "_")
            if subject.cores == 1:
                found.append(stack.enter_context(Running(name, subject, lane, log)))
            elif not lane.first:
                found.append(stack.enter_context(Running(name, subject, Lane(), log)))
        yield found


def compare(comparison: Comparison, rounds: int, logs: Path) -> dict[str, Rounds]:
    """The measures of each subject, round by round, after a short turn of each that does not count.

    The order is reversed every other round, so that nobody always follows the same one.

    Raises:
        SubjectError: one of them ended.
    """
    figures: dict[str, Rounds] = {name: {} for name in comparison.subjects}
    abreast = min(rounds, os.cpu_count() or 1) if comparison.abreast else 1
    with ExitStack() as stack:
        lanes = [stack.enter_context(started(comparison, Lane(first, abreast), logs)) for first in range(abreast)]
        shared = [subject for subject in lanes[0] if not subject.alone] if abreast > 1 else []

        def turns(number: int) -> list[tuple[str, dict[str, float]]]:
            subjects = [subject for subject in lanes[number % abreast] if subject not in shared]
            order = subjects[:: -1 if number // abreast % 2 else 1]
            return [(subject.name, subject.turn(comparison.seconds)) for subject in order]

        if comparison.seconds:
            for subject in lanes[0]:
                subject.turn(comparison.seconds / 2)
        for first in range(0, rounds, abreast):
            numbers = range(first, min(first + abreast, rounds))
            with ThreadPoolExecutor(abreast) as pool:
                taken = [turn for each in pool.map(turns, numbers) for turn in each]
            taken += [(subject.name, subject.turn(comparison.seconds)) for subject in shared for _ in numbers]
            for name, measures in taken:
                for measure, value in measures.items():
                    figures[name].setdefault(measure, []).append(value)
            print("." * len(numbers), end="", file=sys.stderr, flush=True)
    return figures
