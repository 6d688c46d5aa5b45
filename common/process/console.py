"""Console output of a role: one line for each event, with its time, and a progress line every 10 s."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from coop.common.numbers import RETURN_WINDOW
from coop.common.process.files import NO_SPACE
from coop.common.process.output import out

PROGRESS_EVERY = 10.0  # seconds
STALL_AFTER = 5.0  # seconds without progress after which a line is printed
RECENT = 16  # events kept for displays in other processes


class Console:
    """The standard output of a role; thread-safe.

    reported: when the role's main loop last reported its progress, on the monotonic clock; None before the first time.
    """

    def __init__(self) -> None:
        self.reported: float | None = None
        self._lock = threading.Lock()
        self._recent: deque[tuple[int, str]] = deque(maxlen=RECENT)
        self._progress_due = time.monotonic() + PROGRESS_EVERY
        self._stall = StallDetector()

    def event(self, text: str) -> None:
        """Print an event."""
        with self._lock:
            line = stamped(text)
            last = self._recent[-1][0] if self._recent else 0
            self._recent.append((max(last + 1, time.time_ns() // 1_000_000), line))
            say(line)

    def recent(self) -> list[list[int | str]]:
        """The newest events as [number, line]; numbers increase, also across restarts."""
        with self._lock:
            return [list(event) for event in self._recent]

    def progress(self, count: int, reason: str, line: Callable[[], str]) -> None:
        """Print `line()` if it is due, and an event when `count` stops growing for a `reason` or grows again.

        While it does not grow, no progress line is printed.
        """
        now = self.reported = time.monotonic()
        if text := self._stall.check(now, count, reason):
            self.event(text)
        if now >= self._progress_due:
            self._progress_due = now + PROGRESS_EVERY
            if not self._stall.reported:
                say(stamped(line()))


class StallDetector:
    """Notices that a count has not grown for longer than `STALL_AFTER`, and that it grows again; time is an argument.

    reported: the count does not grow, and a line has said so.
    """

    def __init__(self) -> None:
        self.reported = False
        self._count = -1
        self._moved = 0.0

    def check(self, now: float, count: int, reason: str) -> str:
        """The line to print now, empty if there is none. reason: why the count may be waiting, in words."""
        if count != self._count:
            self._count, self._moved = count, now
            reported, self.reported = self.reported, False
            return "goes on" if reported else ""
        if self.reported or not reason or now - self._moved < STALL_AFTER:
            return ""
        self.reported = True
        return reason if reason.startswith("waiting") else f"waiting: {reason}"


class PeerMonitor:
    """Notices that another member of the run has disappeared, and that it or its successor is there again.

    Args:
        role: as in "the learner".
    """

    def __init__(self, role: str) -> None:
        self._role = role
        self._seen = ""
        self._lost = False

    def check(self, there: bool, where: str) -> str:
        """The line to print now, empty if there is none. where: host and process id of the present member."""
        if not there:
            reported, self._lost = self._lost or not self._seen, bool(self._seen)
            return "" if reported else f"{self._role} on {self._seen} does not answer"
        first, back = not self._seen, self._lost or where != self._seen
        self._seen, self._lost = where, False
        return f"{self._role} on {where} is back" if back and not first else ""


def say(text: str, end: str = "\n") -> None:
    """Print a line. If there is no space for it, Python's buffer keeps it for later: a full disk must not end a run."""
    try:
        print(text, end=end, file=out(), flush=True)
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise


def stamped(text: str) -> str:
    """A printable line preceded by the time of day."""
    return f"{time.strftime('%H:%M:%S')} {printable(text)}"


def printable(text: str) -> str:
    """A text without control characters, which other machines could use to change the terminal or to forge lines."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def counted(number: int, noun: str) -> str:
    """A number with its noun, such as "1 actor" or "2 actors"."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def averaged_over(episodes: int) -> str:
    """The episodes whose returns are averaged, in words: all, or the newest of them."""
    newest = f"the last {RETURN_WINDOW} of " if episodes > RETURN_WINDOW else ""
    return f"{newest}{counted(episodes, 'episode')}"


def connected(counts: Mapping[str, int]) -> str:
    """The number of connected processes of the other roles, in words; empty where the run's files alone are known."""
    if not counts:
        return ""
    text = f"{counted(counts.get('replay', 0), 'replay service')}, {counted(counts.get('actor', 0), 'actor')}"
    return f"{text}, {counted(counts['evaluator'], 'evaluator')}" if counts.get("evaluator") else text


def progress_line(status: Mapping[str, Any]) -> str:
    """The status of a learner in one line."""
    episodes = status["episodes"]
    returns = f"return {status['return_mean_100']:.1f} ({averaged_over(episodes)})"
    text = (
        f"step {status['env_steps']:,}/{status['total_steps']:,}  "
        f"{returns if episodes else 'no episode has ended yet'}  "
        f"{status['updates_per_s']:.0f} updates/s  network {status['acting']} acts  {connected(status['connected'])}"
    )
    if status["warning"]:
        text += f"  warning: {status['warning']}"
    if status["missing"]:
        text += f"  lost: {', '.join(status['missing'])}"
    return f"{text}  [{status['waiting']}]" if status["waiting"] else text
