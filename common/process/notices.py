"""Warnings and notes on stderr, which do not stop the program."""

from __future__ import annotations

from collections.abc import Mapping

from coop.common.process.output import complain

_told: set[tuple[str, str]] = set()


def warn(text: str) -> None:
    """Print a warning of a likely mistake."""
    complain(f"warning: {text}")


def warn_once(text: str) -> None:
    """Print a warning, the first time in this process."""
    if (text, "") not in _told:
        _told.add((text, ""))
        warn(text)


def note_renamed(names: Mapping[str, str]) -> None:
    """Print former names that were read and their present ones in one line; each pair once per process."""
    fresh = [f"{former} is now {present}" for former, present in names.items() if (former, present) not in _told]
    _told.update(names.items())
    if fresh:
        complain(f"note: {', '.join(fresh)}")
