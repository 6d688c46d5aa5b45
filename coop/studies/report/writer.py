"""Writes a report: the page, the figures as PNG and PDF with their points as CSV, the tables as CSV and Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from coop.common.errors import RunError, UsageError
from coop.common.process.limits import cores
from coop.common.process.output import warn
from coop.common.process.untrusted import read_bytes, refuse_links
from coop.records.curve import draw_curve
from coop.studies.report.baseline import baseline_figure, baseline_table, find_baseline
from coop.studies.report.figures import figures
from coop.studies.report.packed import EPISODES
from coop.studies.report.page import BEGUN, MARK, page
from coop.studies.report.plots import Figure, draw
from coop.studies.report.results import tables
from coop.studies.report.sources import open_source
from coop.studies.report.study import load_study, read_config


def draw_curves(runs: Path, out: Path) -> list[Path]:
    """Draw the learning curve of every run that has an episode, finished or not, to OUT/RUN/learning_curve.png.

    Raises:
        UsageError: there is no run, or the folder cannot be written.
        RunError: a run's file is torn.
    """
    source = open_source(runs)
    drawn = []
    for run in source.names:
        config = read_config(source, run, runs)
        try:
            episodes = source.columns(run, EPISODES, ("env_step", "return"))
            steps, returns = (np.array(values, np.float64) for values in episodes.values())
        except (OSError, KeyError, ValueError) as error:
            raise RunError(f"{runs / run}: {EPISODES} can't be read: {error!r}") from error
        if len(returns):
            path = out / run / "learning_curve.png"
            refuse_links(path.parent, path)
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                drawn.append(draw_curve(steps, returns, f"{config.env.id}, {config.method}, seed {config.seed}", path))
            except OSError as error:
                raise UsageError(f"--curves {out}: {error.strerror}") from error
    if not drawn:
        raise UsageError(f"{runs}: holds no run with an episode")
    return drawn


def write_report(runs: Path, out: Path, baseline: str | None = None, *, own: bool = False) -> Path:
    """Write the report of a folder of runs, and warn of untrustworthy runs; return its path.

    baseline: a method or a run, from which the differences of the others are reported. own: nobody has named the
    folder, which is a report's by its name.

    Raises:
        UsageError: the folder holds no run, the report's folder cannot be written or has files of its user under the
            report's names, or the baseline is not in it.
        RunError: no run is finished, or a finished one has a torn file.
    """
    study = load_study(runs)
    for line in study.warnings:
        warn(line)
    compared = None if baseline is None else find_baseline(study, baseline)
    results = tables(study)
    made, lacking = figures(study)
    if compared is not None:
        results.insert(0, baseline_table(study, compared))
        made.append(baseline_figure(study, compared))
    try:
        out.mkdir(parents=True, exist_ok=True)
        refuse_links(*out.iterdir())
        drawn = [(figure, out / f"{figure.name}.png") for figure in made]
        index = out / "index.html"
        figure_files = [path.with_suffix(kind) for _, path in drawn for kind in (".png", ".pdf", ".csv")]
        table_files = [out / f"table_{table.name}{kind}" for table in results for kind in (".csv", ".md")]
        _check_own(index, [] if own else [*figure_files, *table_files])
        index.write_text(BEGUN, encoding="utf-8")  # so that a report may replace one that has not ended
        _draw_all(drawn)
        for figure in made:
            (out / f"{figure.name}.csv").write_text(figure.points().csv(), encoding="utf-8")
        for table in results:
            (out / f"table_{table.name}.csv").write_text(table.csv(), encoding="utf-8")
            (out / f"table_{table.name}.md").write_text(table.markdown(), encoding="utf-8")
        index.write_text(page(study, runs, results, drawn, lacking), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror}") from error
    return index


def _check_own(index: Path, others: Sequence[Path]) -> None:
    """Refuse to replace files beside a page that is no report's; raises UsageError, and OSError."""
    if index.exists() and MARK.encode() in read_bytes(index):
        return
    if there := next((path for path in (index, *others) if path.is_file()), None):
        raise UsageError(f"--out {index.parent}: {there.name} there is no report's; name an empty or a new folder")


def _draw_all(figures: Sequence[tuple[Figure, Path]]) -> None:
    """Draw every figure, on all cores: matplotlib takes half of a report's time. Raises OSError as `draw`."""
    workers = max(1, min(len(figures), cores()))
    try:
        # Forked, since a new process would first spend a second on its imports.
        processes = ProcessPoolExecutor(workers, get_context("fork"))
    except OSError:  # they need a /dev/shm that can be written
        for figure, path in figures:
            draw(figure, path)
        return
    with processes as pool:
        for _ in pool.map(draw, *zip(*figures, strict=True)):
            pass
