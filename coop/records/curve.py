"""The learning curve of a run, from its episodes.csv."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from coop.common.numbers import SHORT_WINDOW, running_mean
from coop.common.process.files import write_atomic
from coop.records.checkpoints import EVALUATIONS, RECORDS
from coop.records.reading import Floats, column, read_csv, returns_by_step

NONE: Floats = np.empty((2, 0))


def draw_learning_curve(run_dir: Path, title: str) -> Path | None:
    """Draw the curve of a run directory to `learning_curve.png` there; None if no episode has ended.

    Raises OSError and RunError.
    """
    drawn = learning_curve(run_dir, title)
    if drawn is None:
        return None
    path = run_dir / "learning_curve.png"
    write_atomic(path, drawn)
    return path


def learning_curve(run_dir: Path, title: str) -> bytes | None:
    """The curve of a run directory as a PNG; None if no episode has ended. Raises OSError and RunError."""
    path = run_dir / RECORDS[0]
    rows = read_csv(path)
    if not rows:
        return None
    steps, returns = (column(rows, name, path, 2) for name in ("env_step", "return"))
    evaluated = returns_by_step((run_dir / EVALUATIONS).read_text(encoding="utf-8"))
    return curve_png(steps, returns, title, evaluated)


def draw_curve(steps: ArrayLike, returns: ArrayLike, title: str, path: Path, evaluated: Floats = NONE) -> Path:
    """Draw returns [episodes] against the environment steps [episodes] at which the episodes ended, as a PNG.

    evaluated: of `returns_by_step`.

    Raises:
        OSError: it can't be written; an older one is untouched then.
    """
    write_atomic(path, curve_png(steps, returns, title, evaluated))
    return path


def curve_png(steps: ArrayLike, returns: ArrayLike, title: str, evaluated: Floats = NONE) -> bytes:
    """As `draw_curve`, the bytes of the PNG."""
    # A figure without pyplot leaves the caller's backend, a notebook's for example, as it is.
    from matplotlib import style  # noqa: PLC0415 (half a second, needed once at the end)
    from matplotlib.figure import Figure  # noqa: PLC0415

    content = io.BytesIO()
    with style.context("default"):  # not the user's own, which may need TeX or fonts
        figure = Figure(figsize=(8, 4.5), layout="constrained")
        axes = figure.subplots()
        axes.plot(steps, returns, ".", markersize=2, alpha=0.35, label="episode")
        axes.plot(steps, running_mean(returns, SHORT_WINDOW), linewidth=2, label=f"mean of the last {SHORT_WINDOW}")
        if evaluated.size:
            axes.plot(*evaluated, "o-", markersize=4, label="evaluation")
        axes.set(xlabel="environment steps", ylabel="return", title=title)
        axes.legend(loc="lower right")
        axes.grid(alpha=0.3)
        figure.savefig(content, format="png", dpi=120)
    return content.getvalue()
