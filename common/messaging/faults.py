"""Handles bugs of this program in background threads: each is counted and printed, and no thread ends because of it."""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


class Faults:
    """Counts such errors, and prints each exception type at each place once, with its traceback. Thread-safe."""

    def __init__(self) -> None:
        self._count = 0
        self._printed: set[tuple[str, str]] = set()
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of errors so far."""
        with self._lock:
            return self._count

    def note(self, place: str, error: Exception) -> None:
        """Count an error; print it if it is the first of its type at this place."""
        sort = (place, type(error).__name__)
        with self._lock:
            self._count += 1
            first = sort not in self._printed
            self._printed.add(sort)
        if first:
            print(f"error of this program, {place}:\n{traceback.format_exc()}", end="", file=sys.stderr, flush=True)

    def guarded(self, place: str, call: Callable[[T], None]) -> Callable[[T], None]:
        """Wrap `call` as a callback for Zenoh's threads that notes the exceptions of `call`."""

        def guard(value: T) -> None:
            try:
                call(value)
            except Exception as error:
                self.note(place, error)

        return guard
