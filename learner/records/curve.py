"""The learning curve of a run, from its episodes.csv."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from common.returns import RETURN_WINDOW, running_mean


def draw_learning_curve(run_dir: Path, title: str) -> Path | None:
    """Draw returns against environment steps to `learning_curve.png`; None if no episode has ended."""
    with (run_dir / "episodes.csv").open(encoding="utf-8") as file:
        rows = [(int(row["env_step"]), float(row["return"])) for row in csv.DictReader(file)]
    if not rows:
        return None
    import matplotlib as mpl  # noqa: PLC0415 (half a second, needed once at the end)

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    steps, returns = np.array(rows).T
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    axes.plot(steps, returns, ".", markersize=2, alpha=0.35, label="episode")
    axes.plot(steps, running_mean(returns), linewidth=2, label=f"mean of the last {RETURN_WINDOW}")
    axes.set(xlabel="environment steps", ylabel="return", title=title)
    axes.legend(loc="lower right")
    axes.grid(alpha=0.3)
    path = run_dir / "learning_curve.png"
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
