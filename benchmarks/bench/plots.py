"""A picture of each area: the medians of its subjects with their ranges, as ratios to the reference."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt

from bench.results import Figures, ratios, reference

PLOTS = Path(__file__).parents[1] / "plots"


def draw(figures: Figures, area: str) -> None:
    """Write plots/AREA.png: a row a comparison, a panel a measure."""
    chosen = {title: found for title, found in figures["comparisons"].items() if found["area"] == area}
    measures = {
        title: [name for name in reference(found) if not name.startswith("GFLOP")] for title, found in chosen.items()
    }
    columns = max(map(len, measures.values()))
    plot, panels = plt.subplots(
        len(chosen), columns, figsize=(1.5 + 3.6 * columns, 0.6 + 2.8 * len(chosen)), squeeze=False
    )
    for (title, found), row in zip(chosen.items(), panels, strict=True):
        for measure, panel in zip(measures[title], row, strict=False):
            base = reference(found)[measure]
            having = {name: rounds[measure] for name, rounds in found["subjects"].items() if measure in rounds}
            values = [ratios(measured, base) for measured in having.values()]
            middles = [median(each) for each in values]
            errors = [
                [middle - min(each) for middle, each in zip(middles, values, strict=True)],
                [max(each) - middle for middle, each in zip(middles, values, strict=True)],
            ]
            colours = ["#2166ac" if "coop" in name else "#b0b0b0" for name in having]
            panel.barh(list(having), middles, xerr=errors, color=colours, error_kw={"lw": 0.8})
            panel.axvline(1, color="black", lw=0.8)
            panel.set_title(f"{title}\n{measure}, ratio to {found['reference']}", fontsize=8)
            panel.tick_params(labelsize=7)
            panel.invert_yaxis()
        for panel in row[len(measures[title]) :]:
            panel.axis("off")
    plot.tight_layout()
    PLOTS.mkdir(exist_ok=True)
    plot.savefig(PLOTS / f"{area}.png", dpi=80, metadata={"Software": None})
    plt.close(plot)
