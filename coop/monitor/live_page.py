"""A run's screen as a web page, with curves that grow while it is served."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import Any

from coop.common.messaging.messages.status import LearnerStatus
from coop.common.metrics import METRICS, SPEED
from coop.common.numbers import strict_json
from coop.common.process.console import connected, printable
from coop.monitor.curves import Point, Thinned
from coop.monitor.facts import SILENT_AFTER, detail, facts, place, progress, settings, silence, times, values
from coop.monitor.web import Document, WebServer

FOLLOWS = 3.0  # seconds within which a browser that follows the run asks again
MOST = 400  # points of the curves
CHARTED = [metric for metric in METRICS if metric.chart]
COLUMNS = ("env_steps", *(metric.name for metric in CHARTED))


class ServedPage:
    """Serves the page, which asks for /page.json once a second.

    Args:
        name: of what it shows.
        address: PORT or HOST:PORT, as `--web` gave it.

    Attributes:
        url: of the page.

    Raises:
        UsageError: it can't listen there.
    """

    def __init__(self, name: str, address: str) -> None:
        self._name = name
        self._lock = threading.Lock()
        self._events: list[str] = []
        self._notice, self._ended = "", False
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

    def state(self) -> dict[str, Any]:
        """What /page.json holds: words as they are shown, and the numbers of the curves."""
        with self._lock:
            self._asked_at = time.monotonic()
            if self._ended:
                self._end_was_asked_for.set()
            shown = {"run": printable(self._name), "notice": printable(self._notice), "ended": self._ended}
            return shown | {"events": list(map(printable, self._events))} | self.shown()

    def shown(self) -> dict[str, Any]:
        """What the page shows beside name, notice and events; called while nothing changes."""
        return {}

    def close(self) -> None:
        """Stop serving, once a browser that follows the run has heard that it has ended."""
        if self._ended and time.monotonic() - self._asked_at < FOLLOWS:
            self._end_was_asked_for.wait(FOLLOWS)
        self._server.close()


class LivePage(ServedPage):
    """The page of a run; see `ServedPage`."""

    def __init__(self, run: str, address: str) -> None:
        self._curves: Thinned[Point] = Thinned(MOST)
        self._status: LearnerStatus | None = None
        self._evaluations: Sequence[Point] = ()
        super().__init__(run, address)
        self._notice = "waiting for the learner"

    def show(
        self,
        status: LearnerStatus | None,
        events: Sequence[str],
        silent: float,
        ended: str,
        points: Iterable[Mapping[str, float]] | None = None,
        evaluations: Sequence[Point] = (),
    ) -> None:
        """See `coop.monitor.watch.Page`."""
        with self._lock:
            if points is None:
                points = [values(status)] if status is not None and status is not self._status else []
            for known in points:
                self._curves.add(point(known))
            self._status, self._events, self._evaluations = status, list(events), evaluations
            if ended:
                self._notice, self._ended = f"the run has ended: {ended}", True
            elif status is not None:
                self._notice = silence(silent) if silent > SILENT_AFTER else ""

    def shown(self) -> dict[str, Any]:
        """See `ServedPage`."""
        status = self._status
        if status is None:
            return {}
        members = [[printable(each.name), place(each), each.state, detail(each, status)] for each in status.members]
        return {
            "settings": settings(status),
            "times": times(status),
            "progress": progress(status),
            "facts": list(facts(status).items()),
            "connected": connected(status.connected),
            "members": members,
            "episodes": status.episodes,
            "returns": status.return_history,
            "evaluations": list(self._evaluations),
            "ages": getattr(status.measured, "sample_age_histogram", None) or [],
            "charts": charts(),
            "columns": COLUMNS,
            "points": list(self._curves.points),
        }


def point(known: Mapping[str, float]) -> Point:
    """A value for every name of `COLUMNS`; None where it is not known."""
    band = () if "ratio_measured" in known else ("ratio_ahead",)  # it holds from the first update on
    return [None if name in band else known.get(name) for name in COLUMNS]


def charts() -> list[dict[str, Any]]:
    """The charts over environment steps: title, lines (name of `COLUMNS`, words, style), and the least y or None."""
    found: dict[str, list[tuple[str, str, str]]] = {}
    for metric in CHARTED:
        lines = found.setdefault(metric.chart, [])
        free = sum(style != "bound" for *_, style in lines)
        lines.append((metric.name, metric.curve, "bound" if metric.bound else f"s{free % 3}"))
    return [{"title": title, "lines": lines, "least": 0 if title == SPEED else None} for title, lines in found.items()]
