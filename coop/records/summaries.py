"""The summary at a run's end: summary.json, and one line."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from coop.common.errors import RunError
from coop.common.numbers import finite, strict_json
from coop.common.process.console import averaged_over
from coop.common.process.untrusted import MAX_SETTINGS, read_text

SUMMARY = "summary.json"
_SEAL = "crc32"  # the last field


@dataclass(frozen=True, slots=True)
class Summary:
    """The fields of summary.json.

    return_mean_100, return_sd_100: over the last 100 episodes; 0 if none has ended. transitions_lost,
    duplicates_refused: None if the replay service did not answer. exit: why the run ended.
    """

    method: str
    env: str
    seed: int
    env_steps: int
    updates: int
    episodes: int
    return_mean_100: float
    return_sd_100: float
    wall_seconds: float
    transitions_accepted: int
    transitions_lost: int | None
    duplicates_refused: int | None
    exit: str

    @property
    def title(self) -> str:
        """A short title of the run."""
        return f"{self.env}, {self.method}, seed {self.seed}"

    def __str__(self) -> str:
        returns = f"return of {averaged_over(self.episodes)} {self.return_mean_100:.1f} ({self.return_sd_100:.1f})"
        return (
            f"{self.exit}: {self.env_steps:,} steps, {self.updates:,} updates, "
            f"{returns if self.episodes else 'no episode ended'}, {self.wall_seconds:.0f} s"
        )


_Size = Annotated[int, Meta(ge=0)]


class _Types(msgspec.Struct):
    """The types of the fields of summary.json; earlier versions lack some, and numbers that are not finite are null."""

    method: str = ""
    env: str = ""
    seed: int = 0
    env_steps: int = 0
    updates: int = 0
    episodes: int = 0
    return_mean_100: float | None = None
    return_sd_100: float | None = None
    wall_seconds: float | None = None
    transitions_accepted: int | None = None
    transitions_lost: int | None = None
    duplicates_refused: int | None = None
    exit: str = ""
    fallbacks: list[str] = msgspec.field(default_factory=list)
    records: dict[str, tuple[_Size, _Size]] = msgspec.field(default_factory=dict)


def summary_text(fields: Mapping[str, Any]) -> str:
    """The text of summary.json: the fields, and their checksum."""
    plain = finite(dict(fields))
    return strict_json({**plain, _SEAL: _checksum(plain)}, indent=2) + "\n"


def parse_summary(text: str, place: object) -> dict[str, Any]:
    """Read the text of a summary, without its checksum; place: for the error.

    Raises:
        RunError: it is torn, differs from what was written, or has a field of another type.
    """
    try:
        fields = json.loads(text)
        if not isinstance(fields, dict):
            raise TypeError("not a table")
    except (ValueError, TypeError, RecursionError) as error:
        raise RunError(f"{place}: can't be read: {error}") from error
    if fields.pop(_SEAL, None) not in (None, _checksum(fields)):  # packed ones of earlier versions have none
        raise RunError(f"{place}: wrong checksum")
    try:
        msgspec.convert(fields, _Types)
    except msgspec.ValidationError as error:
        raise RunError(f"{place}: can't be read: {error}") from error
    return fields


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
