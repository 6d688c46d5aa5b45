"""Refusals of misspelt names, with a suggestion."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches


def not_among(known: Sequence[str], name: str, problem: str = "unknown") -> str:
    """Why a name is refused that is none of the known ones: "unknown; did you mean fifo? allowed: fifo, reservoir"."""
    return refusal(problem, closest(name, known), f"allowed: {', '.join(known)}")


def refusal(problem: str, near: str | None, hint: str) -> str:
    """A problem, the name that was probably meant, if there is one, and a hint."""
    return f"{problem}; {hint}" if near is None else f"{problem}; did you mean {near}? {hint}"


def closest(name: str, known: Iterable[str]) -> str | None:
    """The known name most similar to a misspelt one; None if none is."""
    return next(iter(get_close_matches(name, list(known), n=1)), None)
