"""Draws the README's pictures from the studies in results/.

python -m website.pictures
"""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from coop.common.numbers import running_mean
from coop.common.settings.methods import METHODS
from coop.studies.report.measures import score
from coop.studies.report.study import load_study
from website.pages import ROOT

STUDIES = ROOT / "results" / "cartpole"
FOLDER = ROOT / "docs" / "pictures"
WINDOW = 20  # episodes of a running mean
EVICTIONS = {"fifo": "the oldest leaves", "reservoir": "a random one leaves", "prioritized": "the least error leaves"}


def run_picture() -> Figure:
    """A run over processes, episode by episode, and the running mean of five others with the same command."""
    study = load_study(STUDIES / "preset.parquet")
    first, *others = sorted(study.runs, key=lambda run: run.config.seed)
    canvas, axes = plt.subplots(figsize=(7.6, 2.9), layout="constrained")
    colour = METHODS.get("coop").colour
    labels = [f"seeds {others[0].config.seed} to {others[-1].config.seed}: mean of {WINDOW}", *[None] * len(others)]
    for run, label in zip(others, labels, strict=False):
        means = running_mean(run.returns, WINDOW)
        axes.plot(run.end_steps[::3], means[::3], color="#999999", linewidth=0.8, label=label)
    axes.plot(first.end_steps, first.returns, ".", color=colour, alpha=0.35, markersize=3.5, label="seed 0: an episode")
    means = running_mean(first.returns, WINDOW)
    axes.plot(first.end_steps, means, color=colour, linewidth=2, label=f"seed 0: mean of {WINDOW}")
    axes.set(xlabel="environment steps, of two actors", ylabel="return of an episode", ylim=(0, 206), xlim=(0, 50_400))
    axes.set_title("CartPole-v0, coop, buffer of 5,000: learner, replay service and two actors", fontsize=10)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.legend(frameon=False, loc="lower right")
    return canvas


def buffers_picture() -> Figure:
    """Mean return of the last 100 episodes against the size of the buffer: each method, each eviction."""
    study = load_study(STUDIES / "small-buffers.parquet")
    canvas, panels = plt.subplots(1, len(EVICTIONS), figsize=(7.6, 2.7), sharey=True, layout="constrained")
    for axes, (eviction, words) in zip(panels, EVICTIONS.items(), strict=True):
        runs = [run for run in study.runs if run.config.replay.eviction == eviction]
        sizes = sorted({run.config.replay.capacity for run in runs})
        for method in study.methods:
            scores = [[score(run) for run in runs if run.config.method == method and run.config.replay.capacity == size]
                      for size in sizes]  # fmt: skip
            means = [float(np.mean(each)) for each in scores]
            axes.plot(sizes, means, "o-", markersize=3, color=METHODS.get(method).colour, label=method)
        axes.set_xscale("log")
        axes.set_xticks(sizes, [f"{size:,}" for size in sizes], rotation=60, fontsize=7)
        axes.minorticks_off()
        axes.set(ylim=(0, 206), xlabel="transitions in the buffer")
        axes.set_title(f"{eviction}: {words}", fontsize=9)
    panels[0].set_ylabel("return of the last 100 episodes")
    panels[-1].legend(frameon=False, loc="lower right", fontsize=8)
    return canvas


PICTURES = {"run": run_picture, "small-buffers": buffers_picture}


def draw(name: str, folder: Path) -> Path:
    """Write a picture as SVG, whose bytes depend on the data and the version of matplotlib only.

    matplotlib names clip paths and markers after all digits of their places, the last of which differ between
    processors; here they are numbered.
    """
    mpl.use("Agg")
    path = folder / f"{name}.svg"
    with mpl.rc_context(
        {
            "svg.fonttype": "none",
            "svg.hashsalt": "coop",
            "path.simplify_threshold": 0.5,
            "font.size": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
        }
    ):
        canvas = PICTURES[name]()
        canvas.savefig(path, metadata={"Date": None})
        plt.close(canvas)
    names: dict[str, str] = {}
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"\b[mp][0-9a-f]{10}\b", lambda found: names.setdefault(found[0], f"part{len(names)}"), text)
    path.write_text(text, encoding="utf-8")
    return path


if __name__ == "__main__":
    for each in PICTURES:
        print(draw(each, FOLDER))
