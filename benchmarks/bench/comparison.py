"""Subjects that do the same work take turns: each is a process of its own, which waits while the others have theirs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from queue import SimpleQueue
from typing import Self

ROOT = Path(__file__).parents[2]
SUBJECTS = Path(__file__).parent / "subjects"
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
GRACE = 60.0  # seconds for a subject to end after its last turn
LIMIT = 3600.0  # seconds that a turn may take; the longest takes minutes, and a subject that hangs would take for ever

# By round, the value of each measure.
Rounds = dict[str, list[float]]


class SubjectError(Exception):
    """A subject ended before its turns did, or didn't answer."""


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
        abreast: as many turns are taken at once as there are cores, each on its own; those of subjects that use several
            cores follow one after another.
    """

    area: str
    title: str
    subjects: dict[str, Subject]
    reference: str
    rounds: int = 5
    seconds: float = 2.0
    abreast: bool = False


def python_of(venv: str) -> Path:
    """The interpreter of an environment in .bench/."""
    return ROOT / ".bench" / venv / "bin" / "python"


class Running:
    """A subject's process and its children's, one group, on `subject.cores` cores from number `core`."""

    def __init__(self, name: str, subject: Subject, core: int, log: Path) -> None:
        self.name = name
        path = f"{SUBJECTS.parent}:{SUBJECTS.parents[1]}"
        pin = ["taskset", "-c", f"{core}-{core + subject.cores - 1}"] if subject.cores else []
        self._log = log
        with log.open("w") as file:
            self._process = subprocess.Popen(
                [*pin, str(python_of(subject.venv)), str(SUBJECTS / f"{subject.script}.py"), *subject.arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
                process_group=0,
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": path, "PYTHONWARNINGS": "ignore"},
            )

    def ready(self) -> None:
        """Wait until it can take its first turn."""
        self._answer()

    def turn(self, seconds: float, number: int) -> dict[str, float]:
        """The measures of its turn in a round."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{seconds} {number}\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self._ended() from None
        return self._answer()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error:  # it may be in the middle of a long turn, or stopped
            self._send(signal.SIGTERM, signal.SIGCONT)
        try:
            self._process.communicate(timeout=GRACE)
        except subprocess.TimeoutExpired:
            self._send(signal.SIGKILL)
            self._process.communicate()

    def _send(self, *signals: signal.Signals) -> None:
        for each in signals:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, each)

    def _answer(self) -> dict[str, float]:
        assert self._process.stdout is not None
        late = threading.Event()

        def end() -> None:
            late.set()
            self._send(signal.SIGKILL)

        limit = threading.Timer(LIMIT, end)
        try:
            limit.start()
            for line in self._process.stdout:
                if line.startswith("{"):  # a library may print something as it is imported
                    answer: dict[str, float] = json.loads(line)
                    return answer
        finally:
            limit.cancel()
        if late.is_set():
            raise SubjectError(f"{self.name} took more than {LIMIT:,.0f} s; see {self._log}")
        raise self._ended()

    def _ended(self) -> SubjectError:
        self._process.communicate()
        status = self._process.returncode
        words = self._log.read_text(errors="replace").strip().splitlines()[-1:] or ["it said nothing"]
        return SubjectError(f"{self.name} ended (exit status {status}): {words[0]}; see {self._log}")


@contextmanager
def started(comparison: Comparison, core: int, logs: Path) -> Iterator[dict[str, Running]]:
    """The subjects of a comparison that use the core, ready for their first turn; core 0 has those of several cores."""
    with ExitStack() as stack:
        lane = {}
        for name, subject in comparison.subjects.items():
            if subject.cores == 1 or not core:
                log = logs / f"{comparison.title}-{name}-{core}.log".replace(" ", "_")
                lane[name] = stack.enter_context(Running(name, subject, core, log))
                lane[name].ready()
        yield lane


def compare(comparison: Comparison, rounds: int, logs: Path) -> dict[str, Rounds]:
    """The measures of each subject, round by round, after a short turn of each that does not count.

    The order is reversed every other round, so that nobody always follows the same one.

    Raises:
        SubjectError: one of them ended.
    """
    names = list(comparison.subjects)
    turns = [(number, name) for number in range(rounds) for name in (names[::-1] if number % 2 else names)]
    cores = min(rounds, os.cpu_count() or 1) if comparison.abreast else 1
    abreast = [turn for turn in turns if cores > 1 and comparison.subjects[turn[1]].cores == 1]
    alone = [turn for turn in turns if turn not in abreast]
    taken: dict[tuple[int, str], dict[str, float]] = {}
    # The subjects leave first, so that a turn does not outlive an interrupt.
    with ThreadPoolExecutor(cores) as pool, ExitStack() as stack:
        lanes = [stack.enter_context(started(comparison, core, logs)) for core in range(cores)]
        free: SimpleQueue[dict[str, Running]] = SimpleQueue()
        for lane in lanes:
            free.put(lane)

        def take(turn: tuple[int, str]) -> dict[str, float]:
            lane = free.get()
            try:
                return lane[turn[1]].turn(comparison.seconds, turn[0])
            finally:
                free.put(lane)

        if comparison.seconds:
            for subject in lanes[0].values():
                subject.turn(comparison.seconds / 2, 0)
        measured = chain(
            pool.map(take, abreast), (lanes[0][name].turn(comparison.seconds, number) for number, name in alone)
        )
        for turn, measures in zip(abreast + alone, measured, strict=True):
            taken[turn] = measures
            if len(taken) % len(names) == 0:
                print(".", end="", file=sys.stderr, flush=True)
    return {
        name: {measure: [taken[number, name][measure] for number in range(rounds)] for measure in taken[0, name]}
        for name in names
    }
