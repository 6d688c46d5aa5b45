"""Renders the report as one HTML page that needs no other file."""

from __future__ import annotations

import base64
import html
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from coop.common.process.console import counted
from coop.studies.report.plots import Figure
from coop.studies.report.slices import seeds_of
from coop.studies.report.study import Study
from coop.studies.report.table import ResultTable

ENLARGED = 1.5  # screens are read from further away than paper
SHORT = 12  # rows; a longer table is folded
FEW = 5  # runs of a method at one setting, below which intervals say little
STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; max-width: 76rem; margin: 1.5rem auto; padding: 0 1.5rem;
  color: #1b1f24; background: #fff; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 0.6rem; text-wrap: balance; }
h2 { font-size: 1.1rem; margin: 2rem 0 0.5rem; }
figure { margin: 0.5rem 0; }
img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption, .note { color: #555; font-size: 0.85rem; max-width: 62rem; }
.table { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.8rem; font-variant-numeric: tabular-nums; }
thead { border-bottom: 1.5px solid #444; }
th, td { padding: 0.15rem 0.5rem; text-align: right; }
th { vertical-align: bottom; font-weight: 600; line-height: 1.2; }
td { border-bottom: 1px solid #e3e5e8; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
details { border-top: 1px solid #e3e5e8; padding: 0.35rem 0; }
summary { cursor: pointer; font-weight: 600; }
summary small { font-weight: 400; color: #555; }
code { background: #f3f4f6; padding: 0.1rem 0.3rem; }
@media print { body { max-width: none; margin: 0; } figure, table { break-inside: avoid; } }
"""


MARK = "Made by <code>coop-report "
"""What every report of this product has in its page."""
BEGUN = f"<!doctype html><p>{MARK}</code>, which has not ended.</p>\n"
"""The page until the report is whole."""


def page(
    study: Study,
    folder: Path,
    tables: Sequence[ResultTable],
    figures: Sequence[tuple[Figure, Path]],
    lacking: Sequence[str],
) -> str:
    """Render the page: what the study holds, one figure and the tables that sum up first; then everything else, folded.

    Args:
        folder: of the runs.
        figures: each with the path of its PNG, which is embedded in the page; the first one shows what was found.
        lacking: lines about what cannot be shown, with the reason.
    """
    title = html.escape(study.title or f"Runs in {folder.name}")
    sums_up = len(study.methods) > 1 and len(study.settings) > 1
    names = ("baseline", "aggregate", "settings") if sums_up else ("baseline", "settings")
    first = [table for table in tables if table.name in names]
    first = [table for table in first if len(table.rows) <= SHORT] or first[:1]
    shown = [*figures[:1]] + [(figure, png) for figure, png in figures[1:] if figure.name == "baseline"]
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width, initial-scale=1">',
        f"<title>{title}</title><style>{STYLE}</style>",
        f"<h1>{title}</h1>",
        f"<p>{html.escape(_subject(study))}</p>",
        *(f"<h2>{html.escape(figure.title)}</h2>{_figure(figure, png)}" for figure, png in shown),
        *(f"<h2>{html.escape(table.title)}</h2>{table.html()}" for table in first),
        "<h2>Figures</h2>",
        *(
            _folded(figure.title, "", _figure(figure, png), is_open=figure.name == "returns_steps")
            for figure, png in figures
            if (figure, png) not in shown
        ),
        "<h2>Tables</h2>",
        *(_folded(each.title, counted(len(each.rows), "row"), each.html()) for each in tables if each not in first),
        _missing(study, lacking),
        _warnings(study),
        f"<p class=note>{MARK}{html.escape(folder.name)}</code>: {_versions()}. Every figure is "
        "beside this page as PNG and PDF with its points as CSV, every table as CSV and Markdown.</p></html>",
    ]
    return "\n".join(parts) + "\n"


def _subject(study: Study) -> str:
    """What the study holds, and whether it has too few runs of a setting for its intervals."""
    runs = f"{len(study.runs)} of {len(study.runs) + len(study.missing)} runs finished"
    diverged = f", {len(study.diverged)} diverged" if study.diverged else ""
    what = f"{', '.join(study.methods)} on {', '.join(study.environments)}, seeds {seeds_of(study.runs)}"
    fewest = min(filter(None, (len(study.of(method, at)) for method in study.methods for at in study.settings)))
    subject = f"{runs}{diverged}: {what}. {study.eviction}".rstrip()
    if fewest >= FEW:
        return subject
    return f"{subject} Settings with {counted(fewest, 'run')}: their intervals cover less than 95 %."


def _folded(title: str, more: str, content: str, *, is_open: bool = False) -> str:
    head = f"<summary>{html.escape(title)} <small>{more}</small></summary>"
    return f"<details{' open' if is_open else ''}>{head}{content}</details>"


def _figure(figure: Figure, png: Path) -> str:
    data = base64.b64encode(png.read_bytes()).decode()
    caption = html.escape(" ".join(filter(None, (figure.text, f"{figure.counts}." if figure.counts else ""))))
    name = html.escape(figure.title)
    image = f'<img alt="{name}" style="width: {ENLARGED * figure.width:.1f}in" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _missing(study: Study, lacking: Sequence[str]) -> str:
    lines = [f"{name}: {what}" for name, what in study.missing.items()]
    if not lines and not lacking:
        return ""
    items = "".join(f"<li>{html.escape(line)}</li>" for line in [*lacking, *lines])
    return _folded("Missing", f"{counted(len(lines), 'run')}, {counted(len(lacking), 'figure')}", f"<ul>{items}</ul>")


def _warnings(study: Study) -> str:
    items = "".join(f"<li>{html.escape(line)}</li>" for line in study.warnings)
    return _folded("Q-values above their bound", f"{len(study.warnings)} runs", f"<ul>{items}</ul>") if items else ""


def _versions() -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in ("coop-rl", "numpy", "matplotlib"))
    return f"{packages}, Python {platform.python_version()}"
