"""Errors of this program in threads that nobody waits for: no thread ends of one, and none goes by unseen."""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class Faults:
    """Counts such errors; prints each sort at each place once, with its traceback. Safe for threads."""

    def __init__(self) -> None:
        self._count = 0
        self._printed: set[tuple[str, str]] = set()
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """How many there have been."""
        with self._lock:
            return self._count

    def note(self, place: str, error: Exception) -> None:
        """Count one, and print it if it is the first of its sort there."""
        sort = (place, type(error).__name__)
        with self._lock:
            self._count += 1
            first = sort not in self._printed
            self._printed.add(sort)
        if first:
            print(f"error of this program, {place}:\n{traceback.format_exc()}", end="", file=sys.stderr, flush=True)

    def guarded(self, place: str, call: Callable[[T], None]) -> Callable[[T], None]:
        """A callback for Zenoh's threads that notes what `call` raises."""

        def guard(value: T) -> None:
            try:
                call(value)
            except Exception as error:
                self.note(place, error)

        return guard
