"""A run's screen as a web page, with curves that grow while it is served."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from coop.common.messaging.messages.status import LearnerStatus
from coop.common.metrics import METRICS, SPEED
from coop.common.numbers import strict_json
from coop.common.process.console import connected
from coop.monitor.display import printable
from coop.monitor.facts import SILENT_AFTER, detail, facts, place, progress, settings, silence, times, values
from coop.monitor.web import Document, WebServer

FOLLOWS = 3.0  # seconds within which a browser that follows the run asks again
MOST = 400  # points of the curves; with one more, every second one is dropped
CHARTED = [metric for metric in METRICS if metric.chart]
COLUMNS = ("env_steps", *(metric.name for metric in CHARTED))

Point = list[float | None]


class LivePage:
    """Serves the page, which asks for /page.json once a second.

    Args:
        run: its name.
        address: PORT or HOST:PORT, as `--web` gave it.

    Attributes:
        url: of the page.

    Raises:
        UsageError: it can't listen there.
    """

    def __init__(self, run: str, address: str) -> None:
        self._run = run
        self._lock = threading.Lock()
        self._curves = Curves()
        self._status: LearnerStatus | None = None
        self._events: list[str] = []
        self._notice, self._ended = "waiting for the learner", False
        self._asked_at = -math.inf
        self._end_was_asked_for = threading.Event()
        html = files("coop.monitor").joinpath("page.html").read_bytes()
        self._server = WebServer(
            "--web",
            address,
            {
                "/": lambda: Document("text/html; charset=utf-8", html),
                "/page.json": lambda: Document("application/json", strict_json(self.state()).encode()),
            },
        )
        self.url = self._server.url

    def show(self, status: LearnerStatus | None, events: Sequence[str], silent: float, ended: str) -> None:
        """See `coop.monitor.watch.Page`."""
        with self._lock:
            if status is not None and status is not self._status:
                self._curves.add(status)
            self._status, self._events = status, list(events)
            if ended:
                self._notice, self._ended = f"the run has ended: {ended}", True
            elif status is not None:
                self._notice = silence(silent) if silent > SILENT_AFTER else ""

    def state(self) -> dict[str, Any]:
        """What /page.json holds: words as they are shown, and the numbers of the curves."""
        with self._lock:
            self._asked_at = time.monotonic()
            if self._ended:
                self._end_was_asked_for.set()
            status, points = self._status, list(self._curves.points)
            shown = {"run": printable(self._run), "notice": printable(self._notice), "ended": self._ended}
            shown |= {"events": list(map(printable, self._events))}
        if status is None:
            return shown
        members = [[printable(each.name), place(each), each.state, detail(each, status)] for each in status.members]
        return shown | {
            "settings": settings(status),
            "times": times(status),
            "progress": progress(status),
            "facts": list(facts(status).items()),
            "connected": connected(status.connected),
            "members": members,
            "episodes": status.episodes,
            "returns": status.return_history,
            "charts": charts(),
            "columns": COLUMNS,
            "points": points,
        }

    def close(self) -> None:
        """Stop serving, once a browser that follows the run has heard that it has ended."""
        if self._ended and time.monotonic() - self._asked_at < FOLLOWS:
            self._end_was_asked_for.wait(FOLLOWS)
        self._server.close()


class Curves:
    """Keeps at most `MOST` points; with `add` they are of every status, then of every second one, and so on.

    points: the oldest first, each with a value for every name of `COLUMNS`; None where it is not known.
    """

    def __init__(self) -> None:
        self.points: list[Point] = []
        self._every = 1
        self._seen = 0

    def add(self, status: LearnerStatus) -> None:
        """Note a new status; steps that go back, after a resumption from a checkpoint, begin the curves anew."""
        known = values(status)
        if "ratio_measured" not in known:
            known.pop("ratio_ahead", None)  # the band holds from the first update on
        if self.points and status.env_steps < (self.points[-1][0] or 0):
            self.points, self._every, self._seen = [], 1, 0
        if self._seen % self._every == 0:
            self.points.append([known.get(name) for name in COLUMNS])
        self._seen += 1
        if len(self.points) > MOST:
            self.points = self.points[::2]
            self._every *= 2


def charts() -> list[dict[str, Any]]:
    """The charts over environment steps: title, lines (name of `COLUMNS`, words, style), and the least y or None."""
    found: dict[str, list[tuple[str, str, str]]] = {}
    for metric in CHARTED:
        lines = found.setdefault(metric.chart, [])
        free = sum(style != "bound" for *_, style in lines)
        lines.append((metric.name, metric.curve, "bound" if metric.bound else f"s{free % 3}"))
    return [{"title": title, "lines": lines, "least": 0 if title == SPEED else None} for title, lines in found.items()]
