"""The summary that a run leaves behind, as a file."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

SUMMARY = "summary.json"


def strict_json(value: Any, indent: int | None = None) -> str:  # noqa: ANN401 (plain values, tables and lists)
    """A value as JSON, in which numbers that are not finite, which JSON lacks, are null."""
    try:
        return json.dumps(value, indent=indent, allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value), indent=indent)


def _finite(value: Any) -> Any:  # noqa: ANN401
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {name: _finite(each) for name, each in value.items()}
        case list() | tuple():
            return [_finite(each) for each in value]
    return value


def read_summary(run_dir: Path) -> dict[str, Any]:
    """The contents of a run's summary.json; empty if the run has not ended."""
    try:
        text = (run_dir / SUMMARY).read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    summary: dict[str, Any] = json.loads(text)
    return summary
