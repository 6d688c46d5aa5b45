"""All failures that a user can see, and their exit statuses.

CoopError
|- UsageError      an invalid flag, file or grid: exit status 2, before anything starts
|- RunError        a run that could not start or finish: exit status 1
|  |- Interrupted  a signal has ended the work: exit status 130 or 143
|  |- JoinError    no learner answered, or it refused this process
|  '- PeerLost     a role that this one needs stopped answering
'- BadMessage      bytes from the wire that are not a valid message (names the field)
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path

_STANDARD_LIBRARY = os.path.dirname(os.__file__)  # noqa: PTH120 (of a prefix of texts)


class CoopError(Exception):
    """Base of all errors whose text, one line, is meant for the user."""

    exit_status = 1


class UsageError(CoopError):
    """An invalid flag or file; the text names the field, the value and what is allowed."""

    exit_status = 2


class RunError(CoopError):
    """A run that could not start or could not finish."""


class JoinError(RunError):
    """No learner answered within the join time-out, or the learner refused this process."""


class Interrupted(RunError):
    """A signal has interrupted the work; the exit status says which one."""

    def __init__(self, text: str, exit_status: int) -> None:
        super().__init__(text)
        self.exit_status = exit_status


class PeerLost(RunError):
    """A role that this process needs has not answered for too long."""


class BadMessage(CoopError):
    """Bytes that are not a valid message; `field` names the invalid field."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")
        self.field = field


def text_of(error: BaseException | None) -> str:
    """What an exception says; empty if a user's own one fails at that too."""
    try:
        return str(error)
    except Exception:
        return ""


def first_line(error: BaseException | None) -> str:
    """An exception's type and the first line of its text."""
    lines = text_of(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__


def place(error: BaseException) -> str:
    """The last line of users' own code that an exception has come through, " (file:line)"; empty if there is none."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        file = frame.f_code.co_filename
        others = file.startswith((_STANDARD_LIBRARY, "<")) or "site-packages" in file
        if not others and not str(frame.f_globals.get("__name__")).startswith("coop."):
            return f" ({Path(file).name}:{line})"
    return ""


ALSO_CALLED = {
    "lr": "learner.learning_rate",
    "discount": "learner.gamma",
    "buffer_size": "replay.capacity",
    "target_update_interval": "learner.target_update_every",
    "n_envs": "actor.num_envs",
    "timesteps": "total_steps",
    "total_timesteps": "total_steps",
    "n_steps": "replay.n_step",
}
"""Fields of a run by what other libraries call them."""


def not_among(known: Sequence[str], name: str, problem: str = "unknown") -> str:
    """Why a name is refused that is none of the known ones: "unknown; did you mean fifo? allowed: fifo, reservoir"."""
    return refusal(problem, closest(name, known), f"allowed: {', '.join(known)}")


def refusal(problem: str, near: str | None, hint: str) -> str:
    """A problem, the name that was probably meant, if there is one, and a hint."""
    return f"{problem}; {hint}" if near is None else f"{problem}; did you mean {near}? {hint}"


def closest(name: str, known: Iterable[str]) -> str | None:
    """The known name most similar to a misspelt one; None if none is."""
    return next(iter(get_close_matches(name, list(known), n=1)), None)
