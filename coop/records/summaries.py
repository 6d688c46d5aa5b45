"""The summary that a run leaves behind, as a file."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coop.common.errors import RunError
from coop.common.process.untrusted import MAX_SETTINGS, read_text

SUMMARY = "summary.json"
_SEAL = "crc32"  # the last field


def summary_text(fields: Mapping[str, Any]) -> str:
    """The text of summary.json: the fields, and their checksum."""
    finite = _finite(dict(fields))
    return strict_json({**finite, _SEAL: _checksum(finite)}, indent=2) + "\n"


def parse_summary(text: str, place: object) -> dict[str, Any]:
    """Read the text of a summary, without its checksum; place: for the error.

    Raises:
        RunError: it is torn, or differs from what was written.
    """
    try:
        fields = json.loads(text)
        if not isinstance(fields, dict):
            raise TypeError("not a table")
    except (ValueError, TypeError, RecursionError) as error:
        raise RunError(f"{place}: can't be read: {error}") from error
    if fields.pop(_SEAL, None) not in (None, _checksum(fields)):  # packed ones of earlier versions have none
        raise RunError(f"{place}: wrong checksum")
    return fields


def strict_json(value: Any, indent: int | None = None) -> str:  # noqa: ANN401 (plain values, tables and lists)
    """A value as JSON, in which numbers that are not finite, which JSON lacks, are null."""
    try:
        return json.dumps(value, indent=indent, allow_nan=False)
    except ValueError:
        return json.dumps(_finite(value), indent=indent)


def _finite(value: Any) -> Any:  # noqa: ANN401 (as `strict_json`)
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {name: _finite(each) for name, each in value.items()}
        case list() | tuple():
            return [_finite(each) for each in value]
    return value


def read_summary(run_dir: Path) -> dict[str, Any]:
    """The contents of a run's summary.json; empty if the run has not ended. Raises RunError."""
    path = run_dir / SUMMARY
    try:
        text = read_text(path, MAX_SETTINGS)
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path}: can't be read: {getattr(error, 'strerror', None) or error}") from error
    return parse_summary(text, path)


def _checksum(fields: Mapping[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(dict(fields)).encode()):08x}"
