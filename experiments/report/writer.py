"""Writes a report: the page, the figures as PNG with their points as CSV, the tables as CSV and Markdown."""

from __future__ import annotations

from pathlib import Path

from common.errors import UsageError
from experiments.report.figures import figures
from experiments.report.page import page
from experiments.report.plots import draw
from experiments.report.results import tables
from experiments.report.study import load_study
from experiments.report.table import ResultTable


def write_report(runs: Path, out: Path) -> tuple[Path, list[ResultTable]]:
    """Write the report of a folder of runs; the page's path and the tables.

    Raises:
        UsageError: the folder holds no run, or the report's can't be written.
        RunError: no run is finished, or a finished one has a torn file.
    """
    study = load_study(runs)
    made, lacking = figures(study)
    results = tables(study)
    try:
        out.mkdir(parents=True, exist_ok=True)
        drawn = []
        for figure in made:
            draw(figure, out / f"{figure.name}.png")
            (out / f"{figure.name}.csv").write_text(figure.points().csv(), encoding="utf-8")
            drawn.append((figure, out / f"{figure.name}.png"))
        for table in results:
            (out / f"table_{table.name}.csv").write_text(table.csv(), encoding="utf-8")
            (out / f"table_{table.name}.md").write_text(table.markdown(), encoding="utf-8")
        index = out / "index.html"
        index.write_text(page(study, runs, results, drawn, lacking), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror}") from error
    return index, results
