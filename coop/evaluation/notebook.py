"""How runs, buffers and films are shown in notebooks."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from typing import TYPE_CHECKING

from coop.common.errors import CoopError
from coop.common.numbers import RETURN_WINDOW
from coop.records.curve import learning_curve

if TYPE_CHECKING:
    from coop.evaluation.saved import SavedRun


def table_html(values: Mapping[str, str]) -> str:
    """A table of names and texts."""
    rows = (f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in values.items())
    return f"<table>{''.join(rows)}</table>"


def image_html(content: bytes, kind: str) -> str:
    """A picture, inline."""
    return f'<img src="data:image/{kind};base64,{base64.b64encode(content).decode()}">'


def run_html(run: SavedRun) -> str:
    """What a run is, how it ended, and its learning curve so far."""
    config, summary = run.config, run.summary or {}
    told = {
        "run": str(run.path),
        "environment": config.env.id,
        "method, seed": f"{config.method}, {config.seed}",
        "steps": f"{summary.get('env_steps', 0):,} of {config.total_steps:,}" if summary else f"{config.total_steps:,}",
        f"return of the last {RETURN_WINDOW} episodes": f"{summary.get('return_mean_100') or 0:.1f}" if summary else "",
        "end": str(summary.get("exit", "goes on, or was killed")),
    }
    try:
        curve = learning_curve(run.path, f"{config.env.id}, {config.method}, seed {config.seed}")
    except (OSError, CoopError):  # records that are being written, or damaged; reading them names it
        curve = None
    return table_html(told) + (image_html(curve, "png") if curve else "")
