"""The lifecycle of a process: signals, requests to stop, exit status, and the last line of a failure."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType

from common.errors import CoopError, PeerLost
from common.process.files import NO_SPACE

SUPERVISED = "COOP_SUPERVISED"  # process id of a supervisor whose death must end this process, also while it starts
LOOK_EVERY = 0.5  # seconds after which a wait notices a signal that came just before it began
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """A request to stop this process, with its reason; set by a signal, by a message or by the code itself.

    failed: the process must end with exit status 1. exit_status: 128 + signal number after a signal, else 0.
    """

    def __init__(self) -> None:
        # Reentrant, unlike that of an Event: a signal may interrupt code that holds it, and its handler sets the stop.
        self._changed = threading.Condition(threading.RLock())
        self._set = False
        supervisor = os.environ.get(SUPERVISED)
        self._parent = int(supervisor) if supervisor else None
        self.reason = ""
        self.failed = False
        self.exit_status = 0

    def set(self, reason: str, failed: bool = False, exit_status: int = 0) -> None:
        """Request the stop; a later call does not change the reason, `failed` or `exit_status`."""
        with self._changed:
            if not self._set:
                self.reason, self.failed, self.exit_status, self._set = reason, failed, exit_status, True
            self._changed.notify_all()

    def is_set(self) -> bool:
        """True once a stop was requested, or once this process's supervisor has gone."""
        if self._parent is not None and os.getppid() != self._parent:
            self.set("the supervisor is gone")
        return self._set

    def wait(self, seconds: float) -> bool:
        """Sleep until the stop or for `seconds`; return True if the stop has been requested."""
        end = time.monotonic() + seconds
        with self._changed:
            while not self._set and (left := end - time.monotonic()) > 0:
                self._changed.wait(min(left, LOOK_EVERY))
        return self.is_set()

    def on_signals(self) -> None:
        """Make SIGINT and SIGTERM request a clean stop; a second SIGINT interrupts at once.

        A first SIGINT never does, whatever else has requested the stop: a supervisor may pass on by SIGINT what a
        scheduler has told all processes by SIGTERM.
        """
        received: set[int] = set()

        def handle(number: int, frame: FrameType | None) -> None:
            if number == signal.SIGINT and number in received:
                raise KeyboardInterrupt
            received.add(number)
            self.set("interrupted", exit_status=status_after(number))

        for number in SIGNALS:
            signal.signal(number, handle)

    def leave(self) -> None:
        """End the process with the status that the stop requires; return if that is 0.

        Raises:
            PeerLost: the stop is a failure.
            SystemExit: a signal caused the stop; schedulers must not mistake this for completed work.
        """
        if self.failed:
            raise PeerLost(self.reason)
        if self.exit_status:
            sys.exit(self.exit_status)

    def on_thread_failures(self) -> None:
        """Stop the process when an uncaught exception ends one of its threads."""

        def handle(failure: threading.ExceptHookArgs) -> None:
            threading.__excepthook__(failure)  # prints the traceback
            name = failure.thread.name if failure.thread is not None else "?"
            self.set(f"error of this program in the thread {name!r}: {failure.exc_value!r}", failed=True)

        threading.excepthook = handle


def status_after(number: int) -> int:
    """The exit status of a process that a signal ended."""
    return 128 + number


def end_on_signals(program: str) -> None:
    """Make SIGINT and SIGTERM end this process at once, as long as `Stop.on_signals` has not taken over."""

    def handle(number: int, frame: FrameType | None) -> None:
        # Not by an exception: a module that is being imported may swallow it.
        os.write(sys.stderr.fileno(), f"{program}: interrupted\n".encode())
        os._exit(status_after(number))

    for number in SIGNALS:
        signal.signal(number, handle)


def run_main(program: str, main: Callable[[], None]) -> None:
    """Run a command's body; print a CoopError as one line and exit with its status."""
    try:
        main()
    except CoopError as error:
        print(f"{program}: error: {error}", file=sys.stderr, flush=True)
        sys.exit(error.exit_status)
    except BrokenPipeError:  # the reader of the output has gone
        _give_up_output()
        sys.exit(1)
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        print(f"{program}: error: {error.filename or 'output'}: {error.strerror}", file=sys.stderr, flush=True)
        sys.exit(1)
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr, flush=True)
        sys.exit(status_after(signal.SIGINT))
    finally:
        try:
            sys.stdout.flush()
        except OSError:
            _give_up_output()


def _give_up_output() -> None:
    """Keep the interpreter from flushing the rest of the output, which would fail and change the exit status."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
