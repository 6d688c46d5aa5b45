"""What a person sees of a sweep: on a terminal, and on a web page."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from coop.common.process.console import counted, printable, stamped
from coop.monitor.display import LiveDisplay
from coop.monitor.facts import clock
from coop.monitor.live_page import ServedPage
from coop.studies.watch.sweep import Shown, SweepFolder

PLAIN_EVERY = 30.0  # seconds between lines if the output is no terminal
ON_SCREEN = 16  # cells at most
COLOURS = 6  # of the page's lines


def counts_line(sweep: SweepFolder) -> str:
    """How many cells are in which state."""
    return f"{counted(len(sweep.cells), 'cell')}: " + ", ".join(f"{n} {state}" for state, n in sweep.counts().items())


def time_line(sweep: SweepFolder) -> str:
    """The speed and the time left."""
    left = sweep.seconds_left()
    if left is None:
        running = "running" in sweep.counts()
        return "nothing is left to do" if sweep.over else "time left not known yet" if running else "no cell runs now"
    return f"{sweep.speed():,.0f} steps/s, about {clock(left)} left"


class WatchedSweep(LiveDisplay):
    """A sweep on a terminal, and on a page if there is one."""

    def __init__(self, sweep: SweepFolder, page: SweepPage | None = None) -> None:
        super().__init__(PLAIN_EVERY, refreshes=1)
        self._sweep, self._page = sweep, page

    def update(self) -> None:
        """Show the present state."""
        self._sweep.refresh()
        if self._page is not None:
            self._page.refresh()
        super().update()

    def line(self) -> str:
        """The sweep in one line."""
        return stamped(f"{counts_line(self._sweep)}; {time_line(self._sweep)}")

    def picture(self) -> RenderableType:
        """Running and failed cells, and the line."""
        return sweep_screen(self._sweep)


def sweep_screen(sweep: SweepFolder) -> RenderableType:
    """A sweep's screen: progress, the running cells, and the failed ones with their reason."""
    done, total = sweep.steps()
    head = Text.assemble((printable(sweep.name), "bold"), f"  {printable(sweep.title)}")
    table = Table(box=None, header_style="dim", pad_edge=False)
    for column in ("cell", "steps", "", "return", "steps/s"):
        table.add_column(column, justify="left" if column in ("cell", "") else "right")
    running = [cell for cell in sweep.cells if cell.state == "running"]
    for cell in running[:ON_SCREEN]:
        bar = ProgressBar(total=cell.total or 1, completed=cell.step, width=24)
        table.add_row(
            Text(printable(cell.name)), f"{cell.step:,}", bar, f"{cell.mean_return:.1f}", f"{cell.speed:,.0f}"
        )
    more = [Text(f"and {len(running) - ON_SCREEN:,} more", "dim")] if len(running) > ON_SCREEN else []
    failures = [Text(f"{printable(cell.name)}: {_why(cell)}", "red") for cell in sweep.failures()]
    share = f"{done:,} of {total:,} steps ({done / total:.0%})" if total else "no step yet"
    return Group(head, *([table] if running else []), *more, *failures[-ON_SCREEN:],
                 Text(f"{counts_line(sweep)}; {share}; {time_line(sweep)}"))  # fmt: skip


def _why(cell: Shown) -> str:
    return printable(
        f"{cell.state}: {cell.why}" if cell.why and not cell.why.startswith(cell.state) else cell.why or cell.state
    )


class SweepPage(ServedPage):
    """A sweep as a web page: see `coop.monitor.live_page.ServedPage`."""

    def __init__(self, sweep: SweepFolder, address: str) -> None:
        self._sweep = sweep
        self._told: dict[str, Any] = {}
        super().__init__(sweep.name, address)
        self.refresh()

    def refresh(self) -> None:
        """Take over what the sweep's files tell now."""
        told = self._tell()
        with self._lock:
            self._told = told
            self._events = [f"{cell.name}: {_why(cell)}" for cell in self._sweep.failures()]

    def shown(self) -> dict[str, Any]:
        """See `ServedPage`."""
        return self._told

    def _tell(self) -> dict[str, Any]:
        sweep = self._sweep
        done, total = sweep.steps()
        counts = [(state, f"{number}") for state, number in sweep.counts().items()]
        return {
            "settings": printable(sweep.title),
            "times": time_line(sweep),
            "progress": done / total if total else 0.0,
            "facts": [("steps", f"{done:,} of {total:,}"), ("speed", f"{sweep.speed():,.0f} steps/s"), *counts],
            "connected": counts_line(sweep),
            "members": [_row(cell) for cell in _in_order(sweep.cells)],
            "panels": self._panels(),
            "words": {"who": "Cells", "events": "Failures"},
        }

    def _panels(self) -> list[dict[str, Any]]:
        """A chart for each group of cells that differ in their seeds alone, with a line for each seed."""
        groups: dict[str, list[tuple[str, str, list[list[float]]]]] = {}
        for cell in self._sweep.files.values():
            if cell.episodes.curve.points:
                lines = groups.setdefault(cell.group, [])
                lines.append((f"seed {cell.seed}", f"s{len(lines) % COLOURS}", cell.episodes.curve.points))
        return [{"title": printable(title), "lines": lines} for title, lines in groups.items()]


def _in_order(cells: Iterable[Shown]) -> list[Shown]:
    """Running and failed cells first."""
    order = ("running", "failed", "diverged", "stopped", "finished", "waiting")
    return sorted(cells, key=lambda cell: order.index(cell.state))


def _row(cell: Shown) -> list[str]:
    """Name, steps, state and detail, as the page's table has them."""
    steps = f"{cell.step:,} of {cell.total:,}" if cell.total else f"{cell.step:,}"
    detail = f"return {cell.mean_return:.1f}" if cell.step else ""
    if cell.speed:
        detail += f", {cell.speed:,.0f} steps/s"
    return [printable(cell.name), steps, cell.state, _why(cell) if cell.state in ("failed", "diverged") else detail]
