"""What a console tells a person: one line for each event, with its time, and one on the progress now and then."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

PROGRESS_EVERY = 10.0  # seconds
STANDSTILL = 5.0  # seconds without progress that are worth a line
RECENT = 16  # events that displays elsewhere can still be told


class Console:
    """The standard output of a role; safe for threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._recent: deque[tuple[int, str]] = deque(maxlen=RECENT)
        self._progress_due = time.monotonic() + PROGRESS_EVERY
        self._standstill = Standstill()

    def event(self, text: str) -> None:
        """Print what has just happened."""
        with self._lock:
            line = stamped(text)
            last = self._recent[-1][0] if self._recent else 0
            self._recent.append((max(last + 1, time.time_ns() // 1_000_000), line))
            print(line, flush=True)

    def recent(self) -> list[list[int | str]]:
        """The newest events, each with a number that grows, also over restarts: [number, line]."""
        with self._lock:
            return [list(event) for event in self._recent]

    def progress(self, count: int, reason: str, line: Callable[[], str]) -> None:
        """Print `line()` if it is time, and an event where `count` stands still for a `reason`, or moves again.

        While it stands still, there is no progress to print.
        """
        now = time.monotonic()
        if text := self._standstill.look(now, count, reason):
            self.event(text)
        if now >= self._progress_due:
            self._progress_due = now + PROGRESS_EVERY
            if not self._standstill.told:
                print(stamped(line()), flush=True)


class Standstill:
    """Notices that a count stands still for longer than `STANDSTILL`, and that it moves again; time comes in.

    told: the count stands still, and that was worth a line.
    """

    def __init__(self) -> None:
        self.told = False
        self._count = -1
        self._moved = 0.0

    def look(self, now: float, count: int, reason: str) -> str:
        """What is worth a line now; empty if nothing is. reason: why the count may be waiting, in words."""
        if count != self._count:
            self._count, self._moved = count, now
            told, self.told = self.told, False
            return "goes on" if told else ""
        if self.told or not reason or now - self._moved < STANDSTILL:
            return ""
        self.told = True
        return reason if reason.startswith("waiting") else f"waiting: {reason}"


class Sight:
    """Notices that another member of the run is out of sight, and that it or another one in its place is back.

    Args:
        role: as in "the learner".
    """

    def __init__(self, role: str) -> None:
        self._role = role
        self._seen = ""
        self._lost = False

    def look(self, there: bool, where: str) -> str:
        """What is worth a line now; empty if nothing is. where: host and process id of the one that serves now."""
        if not there:
            told, self._lost = self._lost or not self._seen, bool(self._seen)
            return "" if told else f"{self._role} on {self._seen} does not answer"
        first, back = not self._seen, self._lost or where != self._seen
        self._seen, self._lost = where, False
        return f"{self._role} on {where} is back" if back and not first else ""


def stamped(text: str) -> str:
    """A line with its time."""
    return f"{time.strftime('%H:%M:%S')} {text}"


def counted(number: int, noun: str) -> str:
    """A number with its noun, such as "1 actor" or "2 actors"."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def returns(mean: float, episodes: int, window: int = 100) -> str:
    """The mean return over the newest episodes, in words."""
    if not episodes:
        return "no episode has ended yet"
    over = f"last {window} of {counted(episodes, 'episode')}" if episodes > window else counted(episodes, "episode")
    return f"return {mean:.1f} ({over})"


def connected(counts: Mapping[str, int]) -> str:
    """How many processes of the other roles are connected, in words."""
    return f"{counted(counts.get('replay', 0), 'replay service')}, {counted(counts.get('actor', 0), 'actor')}"


def progress_line(status: Mapping[str, Any]) -> str:
    """The status of a learner in one line."""
    text = (
        f"step {status['env_steps']:,}/{status['total_steps']:,}  "
        f"{returns(status['return_mean_100'], status['episodes'])}  "
        f"{status['updates_per_s']:.0f} updates/s  network {status['acting']} acts  {connected(status['connected'])}"
    )
    if status["warning"]:
        text += f"  warning: {status['warning']}"
    if status["missing"]:
        text += f"  lost: {', '.join(status['missing'])}"
    return f"{text}  [{status['waiting']}]" if status["waiting"] else text
