"""Renders the report as one HTML page that needs no other file."""

from __future__ import annotations

import base64
import html
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from experiments.report.plots import Figure
from experiments.report.study import Study
from experiments.report.table import ResultTable

LONG = 40  # rows; a longer table is folded
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; font-size: 0.85rem; display: block; overflow-x: auto; }
th, td { padding: 0.15rem 0.6rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; }
.note { color: #555; font-size: 0.85rem; }
code { background: #f3f3f3; padding: 0.1rem 0.3rem; }
"""


def page(
    study: Study,
    folder: Path,
    tables: Sequence[ResultTable],
    figures: Sequence[tuple[Figure, Path]],
    lacking: Sequence[str],
) -> str:
    """Render the page.

    Args:
        folder: of the runs.
        figures: each with the path of its PNG, which is embedded in the page.
        lacking: lines about what cannot be shown, with the reason.
    """
    title = html.escape(study.title or f"Runs in {folder.name}")
    total = len(study.runs) + len(study.missing)
    axes = ", ".join(study.axes) or "nothing but method and seed"
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><style>{STYLE}</style>",
        f"<h1>{title}</h1>",
        f"<p>{len(study.runs)} of {total} runs finished{_diverged(study)}: {html.escape(', '.join(study.methods))} on "
        f"{html.escape(', '.join(study.environments))}; they differ by {html.escape(axes)}.</p>",
        _missing(study, lacking),
        _warnings(study),
        *(_table(table) for table in tables[:1]),
        *(_figure(figure, png) for figure, png in figures),
        *(_table(table) for table in tables[1:]),
        f"<p class=note>Made by <code>coop-report {html.escape(folder.name)}</code>: {_versions()}.</p></html>",
    ]
    return "\n".join(parts) + "\n"


def _diverged(study: Study) -> str:
    return f", {len(study.diverged)} diverged" if study.diverged else ""


def _missing(study: Study, lacking: Sequence[str]) -> str:
    lines = [f"{name}: {what}" for name, what in study.missing.items()]
    if not lines and not lacking:
        return "<p>Nothing is missing.</p>"
    items = "".join(f"<li>{html.escape(line)}</li>" for line in [*lacking, *lines])
    summary = f"Missing: {len(lines)} runs, {len(lacking)} figures"
    return f"<details {'open' if len(lines) < LONG else ''}><summary>{summary}</summary><ul>{items}</ul></details>"


def _warnings(study: Study) -> str:
    items = "".join(f"<li>{html.escape(line)}</li>" for line in study.warnings)
    return f"<p>Q-values above their bound:</p><ul>{items}</ul>" if items else ""


def _table(table: ResultTable) -> str:
    heading = f"<h2>{html.escape(table.title)}</h2>"
    if len(table.rows) <= LONG:
        return heading + table.html()
    return f"{heading}<details><summary>{len(table.rows)} rows</summary>{table.html()}</details>"


def _figure(figure: Figure, png: Path) -> str:
    data = base64.b64encode(png.read_bytes()).decode()
    name = html.escape(figure.title)
    return f'<h2>{name}</h2><p>{html.escape(figure.text)}</p><img alt="{name}" src="data:image/png;base64,{data}">'


def _versions() -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in ("coop-rl", "rliable", "numpy", "matplotlib"))
    return f"{packages}, Python {platform.python_version()}"
