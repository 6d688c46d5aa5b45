"""Figures fit their page: nothing is cut off, no label covers another."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure as Canvas
from matplotlib.image import imread
from matplotlib.text import Text

from coop.studies.report.intervals import Interval
from coop.studies.report.plots import Figure, Line, Panel, draw

SIZES = np.array([0.0, 50, 100, 200, 300, 500, 1000, 1500, 2000, 3000, 3500, 4000, 5000])


def figure_of(labels: list[str], panels: int, sizes: np.ndarray = SIZES) -> Figure:
    lines = [Line(label, sizes, Interval(sizes, sizes - 1, sizes + 1), dashed=label == "stream-q") for label in labels]
    shown = [Panel("", "capacity", "return", lines, marks=True, sizes=True) for _ in range(panels)]
    return Figure("figure", "A figure", "", "", shown)


@pytest.mark.parametrize("panels", [1, 3])
def test_the_legend_is_not_cut_off(panels: int, tmp_path: Path) -> None:
    draw(figure_of(["dqn", "edql", "g-coop", "coop", "medqn", "stream-q"], panels), tmp_path / "figure.png")
    pixels = imread(tmp_path / "figure.png")[:, :, :3]
    assert (pixels[:, :4] == 1).all()
    assert (pixels[:, -4:] == 1).all()
    assert (pixels != 1).any()


@pytest.mark.parametrize("sizes", [SIZES, SIZES[1:]])
@pytest.mark.parametrize("panels", [1, 3])
def test_no_size_covers_another(
    panels: int, sizes: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[list[tuple[str, float, float]]] = []

    def pdf(canvas: Canvas) -> FigureCanvasPdf:
        drawn.extend(map(labels, canvas.axes))
        return FigureCanvasPdf(canvas)

    monkeypatch.setattr("coop.studies.report.plots.FigureCanvasPdf", pdf)
    draw(figure_of(["dqn", "coop"], panels, sizes), tmp_path / "figure.png")
    assert len(drawn) == panels
    for axis in drawn:
        assert axis[0][0] == f"{sizes[0]:g}"
        assert axis[-1][0] == "5k"
        for (_, _, end), (_, start, _) in pairwise(axis):
            assert end < start


def labels(axes: Axes) -> list[tuple[str, float, float]]:
    """The labels of x and where they begin and end, in pixels."""

    def ends(text: Text) -> tuple[str, float, float]:
        box = text.get_window_extent()
        return text.get_text(), box.x0, box.x1

    return [ends(text) for text in axes.get_xticklabels() if text.get_text()]
