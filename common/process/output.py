"""Standard input, output and error of a command: open from its start, and no failure once nobody reads them.

Warnings and notes go to stderr, and do not stop the program.
"""

from __future__ import annotations

import errno
import fcntl
import io
import os
import select
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TextIO

FIRST_FREE = 3  # the descriptors below are the standard files
# From where a stream's own descriptor is taken: users' code that closes descriptors by their numbers seldom goes so
# far, and no file that is opened later gets this number. `select` takes those below 1024.
FAR = 960
# A reader or a terminal that has gone, and a descriptor that somebody has closed.
GONE = (errno.EPIPE, errno.EIO, errno.EBADF, errno.ENXIO, errno.ECONNRESET, errno.ESTALE, errno.ENOTCONN)

_streams: dict[int, _Text] = {}


def keep_standard_files() -> None:
    """Open /dev/null in the place of each standard file that is closed.

    Otherwise the next file to be opened, a lock or a checkpoint, would take its number, and get what is printed.
    """
    for number in range(FIRST_FREE):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            os.dup2(opened, number)  # inheritable, as standard files are
            if opened != number:
                os.close(opened)


def take_standard_files() -> None:
    """Make `sys.stdout` and `sys.stderr` streams of this process's own, which outlive what users' code does to them."""
    keep_standard_files()
    if sys.stdin is None:
        sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 (for the whole process)
    for number, name in ((1, "stdout"), (2, "stderr")):
        present = getattr(sys, name)
        if present is getattr(sys, f"__{name}__"):  # otherwise a caller in this process has redirected it
            _streams[number] = stream = _Text(number, present)
            setattr(sys, name, stream)
    sys.unraisablehook = _unraisable


def _unraisable(failure: sys.UnraisableHookArgs) -> None:
    """Print what no code can be told of, but not, as Python 3.13 began to, that a file's descriptor had been closed.

    Users' code has closed it by its number; the file says so where it is written to.
    """
    if getattr(failure.exc_value, "errno", None) != errno.EBADF:
        sys.__unraisablehook__(failure)


def out() -> TextIO | None:
    """Standard output; None if there is none."""
    return _streams.get(1, sys.stdout)


def on_output_gone(call: Callable[[], None]) -> None:
    """Call `call`, in the thread that prints, once printing shows that nobody reads standard output any more."""
    if 1 in _streams:
        _streams[1].raw.on_gone = call


def complain(text: str) -> None:
    """Print a line to standard error."""
    if (stream := _streams.get(2, sys.stderr)) is not None:  # otherwise `print` would take standard output
        print(text, file=stream, flush=True)


def flush_at_end() -> None:
    """Write what Python's buffer keeps, or give it up, so that the interpreter does not fail over it."""
    stream = out()
    if stream is not None:
        try:
            stream.flush()
        except (OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class _Raw(io.FileIO):
    """A descriptor to write to; once nobody can read it any more, what is written is dropped.

    on_gone: called then. lossy: what can't be written for any other reason is dropped too.
    """

    def __init__(self, descriptor: int, *, lossy: bool) -> None:
        super().__init__(descriptor, "wb", closefd=False)  # it lives as long as the process
        self.on_gone: Callable[[], None] = lambda: None
        self._gone = False
        self._lossy = lossy

    def write(self, data: Any, /) -> int:  # noqa: ANN401 (anything with bytes)
        size = memoryview(data).nbytes
        while not self._gone:
            try:
                written = super().write(data)
            except OSError as error:
                if error.errno not in GONE:
                    if self._lossy:
                        break
                    raise
                self._gone = True
                self.on_gone()
            else:
                if written is not None:
                    return written
                select.select((), (self,), ())  # another process has made the terminal non-blocking
        return size


def _copy(number: int) -> int:
    """A copy of a descriptor, out of the way if this process may have so many."""
    with suppress(OSError):
        return fcntl.fcntl(number, fcntl.F_DUPFD_CLOEXEC, FAR)
    return fcntl.fcntl(number, fcntl.F_DUPFD_CLOEXEC, FIRST_FREE)


class _Text(io.TextIOWrapper):
    """A standard stream on a descriptor of its own; letters that the terminal lacks are written as escapes."""

    def __init__(self, number: int, present: TextIO | None) -> None:
        self.raw = _Raw(_copy(number), lossy=number == 2)
        super().__init__(
            io.BufferedWriter(self.raw),
            encoding=getattr(present, "encoding", None) or "utf-8",
            errors="backslashreplace",
            line_buffering=number == 2 or self.raw.isatty(),
            write_through=bool(getattr(present, "write_through", False)),
        )

    def close(self) -> None:
        """Write what is left; users' code must not take the stream away."""
        self.flush()


_warned: set[str] = set()


def warn(text: str) -> None:
    """Print a warning of a likely mistake."""
    complain(f"warning: {text}")


def warn_once(text: str) -> None:
    """Print a warning, the first time in this process."""
    if text not in _warned:
        _warned.add(text)
        warn(text)
