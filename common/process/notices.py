"""Lines on stderr that a person should see although nothing is wrong enough to stop."""

from __future__ import annotations

import sys
from collections.abc import Mapping

_told: set[tuple[str, str]] = set()


def warn(text: str) -> None:
    """Say what is likely to be a mistake."""
    print(f"warning: {text}", file=sys.stderr, flush=True)


def note_renamed(names: Mapping[str, str]) -> None:
    """Say in one line which former names were read, and the present ones; each pair once in this process's life."""
    fresh = [f"{former} is now {present}" for former, present in names.items() if (former, present) not in _told]
    _told.update(names.items())
    if fresh:
        print(f"note: {', '.join(fresh)}", file=sys.stderr, flush=True)
