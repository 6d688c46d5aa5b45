"""Warnings and notes on stderr, which do not stop the program."""

from __future__ import annotations

from coop.common.process.output import complain

_told: set[str] = set()


def warn(text: str) -> None:
    """Print a warning of a likely mistake."""
    complain(f"warning: {text}")


def warn_once(text: str) -> None:
    """Print a warning, the first time in this process."""
    if text not in _told:
        _told.add(text)
        warn(text)
