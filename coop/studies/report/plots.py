"""Figures as data, and how they are drawn: panels of lines, as they are printed in a paper."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from coop.common.settings.methods import METHODS
from coop.studies.report.intervals import Interval, over_seeds
from coop.studies.report.study import Floats
from coop.studies.report.table import ResultTable, Value

# For lines that are no methods, and for methods without a colour of their own.
OTHERS = ["#000000", "#0072B2", "#CC79A7", "#999933", "#882255", "#44AA99"]
COLUMNS = 3  # of panels
WIDTH = 7.2  # inches, of a page's text; a single panel has two thirds of it
LEGEND = 6  # labels beside each other in a legend as wide as a page's text
HEIGHT = 1.9  # inches, of a panel
DPI = 170
TICK = 0.24  # inches, of a line of a label on the y axis
LONG_TICK = 24  # letters in such a line
BESIDE = 0.5  # of the distance of two sizes, taken by the methods at one
STYLE: dict[Any, Any] = {
    "font.size": 8, "axes.titlesize": 8, "axes.labelsize": 8, "xtick.labelsize": 7, "ytick.labelsize": 7,
    "legend.fontsize": 8, "legend.frameon": False, "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "grid.alpha": 0.3, "grid.linewidth": 0.5, "axes.linewidth": 0.6, "lines.linewidth": 1.2,
    "lines.markersize": 3.5, "pdf.fonttype": 42,
}  # fmt: skip


@dataclass(frozen=True)
class Line:
    """Points with their intervals; x and each y are float64 [n]. An interval of nan only is not drawn.

    dashed: a level to compare with, with a marker at x = 0 only. faint: small dots without a line, of single runs.
    """

    label: str
    x: Floats
    y: Interval
    dashed: bool = False
    faint: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    marks: draw markers and error bars instead of bands. share: y ranges from 0 to 1. sizes: the values of x are sizes
    of the buffer, drawn at equal distances, and the lines beside each other at each. ticks: labels of the positions 0,
    1, ... of x, which is drawn downwards, and y to the right. reference: a value of y to compare with.
    """

    title: str
    x: str
    y: str
    lines: Sequence[Line]
    marks: bool = False
    sizes: bool = False
    log_y: bool = False
    share: bool = False
    ticks: Sequence[str] = ()
    reference: float | None = None


@dataclass(frozen=True)
class Figure:
    """Panels; `name`: of its files. `text`: how to read it. `counts`: the numbers of its runs and seeds.

    same_y: the panels share their y axis.
    """

    name: str
    title: str
    text: str
    counts: str
    panels: Sequence[Panel] = ()
    same_y: bool = False

    @property
    def columns(self) -> int:
        """Panels beside each other."""
        return 2 if len(self.panels) == 4 else min(COLUMNS, len(self.panels))

    @property
    def width(self) -> float:
        """Inches on a page as wide as paper's."""
        wide = self.columns > 1 or any(len(tick) > LONG_TICK for panel in self.panels for tick in panel.ticks)
        return WIDTH if wide else WIDTH * 2 / 3

    def points(self) -> ResultTable:
        """All points drawn, as one table."""
        rows: list[list[Value]] = [
            [panel.title, line.label, *(float(value) for value in point)]
            for panel in self.panels
            for line in panel.lines
            for point in zip(line.x, *line.y, strict=True)
        ]
        return ResultTable(self.name, self.title, ["panel", "line", "x", "y", "low", "high"], rows)


def seed_lines(label: str, place: float, seeds: Floats) -> list[Line]:
    """One value of each seed as dots, and their mean with its t interval, at a tick."""
    nothing = np.full(len(seeds), np.nan)
    mean = Interval(*np.array(over_seeds(seeds))[:, None])
    dots = Line(label, np.full(len(seeds), place), Interval(seeds, nothing, nothing), faint=True)
    return [dots, Line(label, np.array([place]), mean)]


def draw(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG, and beside it as a PDF; the same data give the same bytes."""
    number, columns = len(figure.panels), figure.columns
    rows = math.ceil(number / columns)
    lines = [sum(1 + _wrapped(tick).count("\n") for tick in panel.ticks) for panel in figure.panels]
    tall = max(HEIGHT, 0.6 + TICK * max(lines))
    size = (figure.width, tall * rows + 0.4)
    with style.context(["default", STYLE]):  # not the user's own, which may need TeX or fonts
        canvas = Canvas(size, DPI, layout="constrained")
        grid = canvas.subplots(rows, columns, squeeze=False, sharey=figure.same_y)
        colours: dict[str, str] = {}
        handles: dict[str, Line2D] = {}
        for place, (axes, panel) in enumerate(zip(grid.flat, figure.panels, strict=False)):
            for line, x in zip(panel.lines, _places(panel), strict=True):
                others = [] if panel.ticks else list(colours.values())  # a tick names its line
                colour = colours.setdefault(line.label, _colour(line.label, others))
                _draw_line(axes, panel, line, x, colour)
                if not line.faint:
                    handles.setdefault(line.label, _handle(panel, line, colour))
            _finish_panel(axes, panel, columns)
            below = place + columns < number and figure.panels[place + columns].x == panel.x
            beside_another = place % columns > 0 and figure.panels[place - 1].y == panel.y
            _name_axes(axes, panel, x=not below, y=not beside_another)
            if panel.ticks and place % columns and panel.ticks == figure.panels[place - 1].ticks:
                axes.tick_params(labelleft=False)
        for axes in grid.flat[number:]:
            axes.axis("off")
        if len(handles) > 1 and not any(set(panel.ticks) >= handles.keys() for panel in figure.panels):
            legend_rows = math.ceil(len(handles) / (LEGEND * figure.width / WIDTH))
            per_row = math.ceil(len(handles) / legend_rows)
            canvas.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=per_row)
        # Not by `savefig`, which draws each file twice; after the first one everything has its place.
        FigureCanvasAgg(canvas).print_png(path, metadata={"Software": None})  # type: ignore[no-untyped-call]
        canvas.set_layout_engine("none")
        FigureCanvasPdf(canvas).print_pdf(path.with_suffix(".pdf"), metadata={"CreationDate": None})  # type: ignore[no-untyped-call]


def _places(panel: Panel) -> list[Floats]:
    """Where the points of each line are drawn along x."""
    if not panel.sizes:
        return [line.x for line in panel.lines]
    sizes = sorted({float(x) for line in panel.lines for x in line.x})
    apart = [number for number, line in enumerate(panel.lines) if not line.dashed]
    middle, step = (len(apart) - 1) / 2, BESIDE / max(1, len(apart) - 1)
    return [
        np.searchsorted(sizes, line.x).astype(np.float64)
        + (0.0 if line.dashed else (apart.index(number) - middle) * step)
        for number, line in enumerate(panel.lines)
    ]


def _draw_line(axes: Axes, panel: Panel, line: Line, x: Floats, colour: str) -> None:
    value, low, high = line.y
    if line.faint:
        axes.plot(value, x, "o", color=colour, alpha=0.4, markersize=3, markeredgewidth=0, zorder=3)
    elif line.dashed:
        axes.plot(x, value, "o--", color=colour, markevery=line.x == 0)
        axes.fill_between(x, low, high, color=colour, alpha=0.1, linewidth=0)
    elif panel.marks:
        bounds = np.nan_to_num(np.stack([(value - low).clip(0), (high - value).clip(0)]))
        style = "o" if panel.ticks else "o-"
        if panel.ticks:
            axes.errorbar(value, x, xerr=bounds, fmt=style, capsize=2, color=colour, elinewidth=1)
        else:
            axes.errorbar(x, value, yerr=bounds, fmt=style, capsize=2, color=colour, elinewidth=0.8)
    else:
        axes.plot(x, value, color=colour)
        axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)


def _handle(panel: Panel, line: Line, colour: str) -> Line2D:
    """A line's sample in the legend."""
    style: Literal["none", "--", "-"] = "none" if panel.ticks else "--" if line.dashed else "-"
    return Line2D([], [], color=colour, linestyle=style, marker="o" if panel.marks else "none")


def _finish_panel(axes: Axes, panel: Panel, columns: int) -> None:
    """Set scales, limits, ticks and title."""
    axes.set_title("\n".join(textwrap.wrap(panel.title, 100 // columns)))
    axes.xaxis.set_major_locator(MaxNLocator(4 if columns == COLUMNS else 6))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    if panel.sizes:
        _name_sizes(axes, panel, columns)
    if panel.ticks:
        axes.set_yticks(range(len(panel.ticks)), list(map(_wrapped, panel.ticks)))
        axes.set_ylim(len(panel.ticks) - 0.5, -0.5)
        axes.grid(visible=False, axis="y")
        if panel.reference is not None:
            axes.axvline(panel.reference, color="#555555", linewidth=0.8, linestyle="--")
        if panel.share:
            axes.set_xlim(-0.03, 1.03)
    elif panel.share:
        axes.set_ylim(-0.03, 1.03)
    if panel.log_y and all((line.y.value > 0).all() for line in panel.lines):
        axes.set_yscale("log")


def _name_axes(axes: Axes, panel: Panel, *, x: bool, y: bool) -> None:
    """Name the axes, except where the panel below or beside bears the same name."""
    across, up = (panel.y, panel.x) if panel.ticks else (panel.x, panel.y)
    if x or panel.ticks:
        axes.set_xlabel(across)
    if y or panel.ticks:
        axes.set_ylabel("\n".join(textwrap.wrap(up, 26)))


def _wrapped(tick: str) -> str:
    return "\n".join(textwrap.wrap(tick, 2 * LONG_TICK))


def _colour(label: str, taken: Sequence[str]) -> str:
    """The method's own colour, or the next one of the others."""
    own = METHODS.get(label).colour if label in METHODS.names() else None
    return own or OTHERS[sum(colour in OTHERS for colour in taken) % len(OTHERS)]


def _name_sizes(axes: Axes, panel: Panel, columns: int) -> None:
    """Name the sizes at their places."""
    sizes = sorted({float(x) for line in panel.lines for x in line.x})
    axes.set_xlim(-0.6, len(sizes) - 0.4)
    axes.set_xticks(range(len(sizes)), _labels(axes, sizes, columns))


def _labels(axes: Axes, values: Sequence[float], columns: int) -> list[str]:
    """Labels of ticks, of which one that would touch another is empty; the last and then the first ones stay."""
    scale = axes.transData + axes.transAxes.inverted()
    letter = 0.0025 + 0.01 * columns  # share of the axis
    labels = list(map(_short, values))
    kept: list[tuple[float, int]] = []
    for number in (len(values) - 1, *range(len(values) - 1)):
        place, length = float(scale.transform((number, 1.0))[0]), len(labels[number])
        if any(abs(place - other) < letter * (length + letters + 2) / 2 for other, letters in kept):
            labels[number] = ""
        else:
            kept.append((place, length))
    return labels


def _short(value: float) -> str:
    """A number on an axis: 30k for 30,000."""
    return f"{value / 1000:g}k" if abs(value) >= 1000 else f"{value:g}"
