"""Extras: libraries that only some flags need."""

from __future__ import annotations

from importlib.util import find_spec

from coop.common.errors import UsageError


def check_extra(flag: str, extra: str, module: str) -> None:
    """Raise UsageError if the library that a flag needs is not installed."""
    if find_spec(module) is None:
        raise UsageError(f"{flag}: needs the extra {extra!r}: pip install 'coop-rl[{extra}]'")
