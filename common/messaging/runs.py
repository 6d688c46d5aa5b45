"""Which run a message belongs to. Runs may share a name, so who has joined one also gives the id that it began with."""

from __future__ import annotations

from coop.common.errors import BadMessage
from coop.common.messaging.wire import Message

_SEPARATOR = "#"  # no key may hold it, so no run's name does


def identified(name: str, run_id: int) -> str:
    """A run's name and its id, as messages have them."""
    return f"{name}{_SEPARATOR}{run_id:x}"


def name_of(run: str) -> str:
    """The name of a run, with or without its id."""
    return run.partition(_SEPARATOR)[0]


def check_run(message: Message, run: str) -> Message:
    """Return a message of a run; one without an id may be any run's of this name.

    Raises:
        BadMessage: it is another run's.
    """
    theirs = message.run
    if theirs != run and (name_of(theirs) != name_of(run) or (_SEPARATOR in theirs and _SEPARATOR in run)):
        raise BadMessage("run", f"{theirs!r}; this is run {run!r}")
    return message
