"""Bugs of the protocol, planted by hand for the simulator to find."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

PLANTED: dict[str, tuple[str, Callable[[ExitStack], None]]] = {}


@contextmanager
def planted(name: str) -> Iterator[None]:
    """Run with a planted bug; with none if the name is empty."""
    with ExitStack() as stack:
        if name:
            PLANTED[name][1](stack)
        yield
