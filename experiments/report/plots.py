"""Figures as data, and how they are drawn: panels of lines, with seeds and run counts below."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from common.settings.methods import METHODS
from experiments.report.measures import Interval
from experiments.report.study import Floats
from experiments.report.table import ResultTable, Value

# For lines that are no methods, and for methods without a colour of their own.
OTHERS = ["#000000", "#0072B2", "#CC79A7", "#999933", "#882255", "#44AA99"]
COLUMNS = 3  # of panels
DECADE = 10
LETTERS = 14  # of small print per inch


@dataclass(frozen=True)
class Line:
    """Points with their intervals; x and each y are float64 [n]. An interval of nan only is not drawn."""

    label: str
    x: Floats
    y: Interval
    dashed: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    marks: draw markers and error bars instead of bands. share: y ranges from 0 to 1. wide_x: use a logarithmic x axis
    if the numbers span more than a decade. ticks: labels of the positions 0, 1, ... on x.
    """

    title: str
    x: str
    y: str
    lines: Sequence[Line]
    marks: bool = False
    wide_x: bool = False
    log_y: bool = False
    share: bool = False
    ticks: Sequence[str] = ()


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

    def points(self) -> ResultTable:
        """All points drawn, as one table."""
        rows: list[list[Value]] = [
            [panel.title, line.label, *(float(value) for value in point)]
            for panel in self.panels
            for line in panel.lines
            for point in zip(line.x, *line.y, strict=True)
        ]
        return ResultTable(self.name, self.title, ["panel", "line", "x", "y", "low", "high"], rows)


def draw(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG; the same data give the same bytes."""
    mpl.use("Agg")
    columns = min(COLUMNS, len(figure.panels))
    rows = math.ceil(len(figure.panels) / columns)
    size = (max(6.4, 4.4 * columns), 3.4 * rows + 0.9)
    canvas, grid = plt.subplots(rows, columns, squeeze=False, figsize=size, layout="constrained", sharey=figure.same_y)
    colours: dict[str, str] = {}
    for axes, panel in zip(grid.flat, figure.panels, strict=False):
        _draw_panel(axes, panel, colours)
    for axes in grid.flat[len(figure.panels) :]:
        axes.axis("off")
    canvas.suptitle(figure.title)
    below = textwrap.fill(figure.counts, round(LETTERS * size[0]))
    canvas.supxlabel(below, fontsize="small", color="#555555")
    canvas.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(canvas)


def _draw_panel(axes: Axes, panel: Panel, colours: dict[str, str]) -> None:
    for line in panel.lines:
        colour = colours.setdefault(line.label, _colour(line.label, list(colours.values())))
        value, low, high = line.y
        if panel.marks:
            below, above = (value - low).clip(0), (high - value).clip(0)
            style = "o" if panel.ticks else "o--" if line.dashed else "o-"
            axes.errorbar(line.x, value, (below, above), fmt=style, capsize=3, color=colour, label=line.label)
        else:
            axes.plot(line.x, value, color=colour, label=line.label)
            axes.fill_between(line.x, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.set(xlabel=panel.x, ylabel=panel.y, title=panel.title)
    axes.grid(alpha=0.3)
    if panel.wide_x:
        _spread_x(axes, panel)
    if panel.share:
        axes.set_ylim(-0.03, 1.03)
    if panel.log_y and all((line.y.value > 0).all() for line in panel.lines):
        axes.set_yscale("log")
    if panel.ticks:
        axes.set_xticks(range(len(panel.ticks)), panel.ticks, rotation=20)
        axes.set_xlim(-0.5, len(panel.ticks) - 0.5)
    elif panel.lines:
        axes.legend(fontsize="small")


def _colour(label: str, taken: Sequence[str]) -> str:
    """The method's own colour, or the next one of the others."""
    own = METHODS.get(label).colour if label in METHODS.names() else None
    return own or OTHERS[sum(colour in OTHERS for colour in taken) % len(OTHERS)]


def _spread_x(axes: Axes, panel: Panel) -> None:
    values = sorted({float(x) for line in panel.lines for x in line.x})
    sizes = [value for value in values if value]
    if sizes and sizes[-1] >= DECADE * sizes[0]:
        if len(sizes) == len(values):
            axes.set_xscale("log")
        else:
            axes.set_xscale("symlog", linthresh=sizes[0], linscale=0.5)  # 0 has no place on a logarithmic axis
        axes.set_xticks(values, [f"{value:g}" for value in values], rotation=45)
        axes.minorticks_off()
