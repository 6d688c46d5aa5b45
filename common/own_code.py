"""Users' own code that fails: the setting that names it, and the place in it, in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from coop.common.errors import CoopError, RunError, place
from coop.common.imports import describe


def described(error: BaseException) -> str:
    """What a user's code has raised, in one line, with the last line of that code that it came through."""
    return describe(error) + place(error)


def brief(value: object) -> str:
    """What a user's code has given, in one line: its text or, if that is long, its type."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else type(value).__name__


@contextmanager
def own_code(name: str) -> Iterator[None]:
    """Within it a user's own code runs: what it raises becomes a RunError. name: its setting, with the value.

    It may be anything, such as SystemExit, which must not end a run; but an interrupt may be a signal's.
    """
    try:
        yield
    except (CoopError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise RunError(f"{name} raised {described(error)}") from error
