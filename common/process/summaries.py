"""The summary that a run leaves behind, as a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

SUMMARY = "summary.json"


def read_summary(run_dir: Path) -> dict[str, Any]:
    """The contents of a run's summary.json; empty if the run has not ended."""
    try:
        text = (run_dir / SUMMARY).read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    summary: dict[str, Any] = json.loads(text)
    return summary
