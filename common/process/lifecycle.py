"""The lifecycle of a process: signals, requests to stop, exit status, and the last line of a failure."""

from __future__ import annotations

import atexit
import errno
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from coop.common.errors import CoopError, PeerLost, first_line, place, text_of
from coop.common.process.files import NO_SPACE
from coop.common.process.limits import memory_limit
from coop.common.process.output import complain, flush_at_end, on_output_gone, warn

SUPERVISED = "COOP_SUPERVISED"  # process id of a supervisor whose death must end this process, also while it starts
SUPERVISOR_EVERY = 0.02  # seconds between looks for the supervisor, and for who handles signals
LOOK_EVERY = 0.5  # seconds after which a wait notices a signal that came just before it began
LEFT = 2.0  # seconds for users' threads to end by themselves
_OUT_OF_MEMORY = (
    (RuntimeError, "can't allocate memory"),
    (ImportError, "failed to map segment"),
    (ImportError, "Cannot allocate memory"),
)
_OUT_OF_PROCESSES = (  # or of memory
    (RuntimeError, "can't start new thread"),
    (BlockingIOError, "Resource temporarily unavailable"),  # of a fork
    (BaseException, "can't spawn worker thread"),  # Zenoh's, which is no Exception
)
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
Handler = Callable[[int, FrameType | None], None]


class ProcessExit(SystemExit):
    """The end of this process with a status that the program has chosen itself; users' code raises SystemExit."""


class Signalled(KeyboardInterrupt):
    """A signal, where no `Stop` takes it; not an Exception, which users' code may swallow."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.exit_status = status_after(number)


def is_interrupt(error: BaseException) -> bool:
    """Whether a signal has raised an exception; a user's code may raise KeyboardInterrupt for reasons of its own."""
    in_main = threading.current_thread() is threading.main_thread()  # where Python handles signals
    handled = in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    pythons = handled and isinstance(error, KeyboardInterrupt)
    return pythons or isinstance(error, Signalled)


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
        self._handler: Handler | None = None
        self._look_at = 0.0

    def set(self, reason: str, failed: bool = False, exit_status: int = 0) -> None:
        """Request the stop; a later call does not change the reason, `failed` or `exit_status`."""
        with self._changed:
            if not self._set:
                self.reason, self.failed, self.exit_status, self._set = reason, failed, exit_status, True
            self._changed.notify_all()

    def is_set(self) -> bool:
        """True once a stop was requested, or once this process's supervisor has gone."""
        now = time.monotonic()
        if now >= self._look_at:  # which takes long beside a step of a small environment
            self._look_at = now + SUPERVISOR_EVERY
            if self._parent is not None and os.getppid() != self._parent:
                self.set("the supervisor is gone")
            if self._handler is not None and {signal.getsignal(number) for number in SIGNALS[:2]} != {self._handler}:
                self._take_signals(self._handler)  # users' code has taken them over
        return self._set

    def wait(self, seconds: float) -> bool:
        """Sleep until the stop or for `seconds`; return True if the stop has been requested."""
        end = time.monotonic() + seconds
        with self._changed:
            while not self._set and (left := end - time.monotonic()) > 0:
                self._changed.wait(min(left, LOOK_EVERY))
        return self.is_set()

    def on_signals(self) -> None:
        """Make SIGINT, SIGTERM and SIGHUP request a clean stop; a second SIGINT interrupts at once.

        A first SIGINT never does, whatever else has requested the stop: a supervisor may pass on by SIGINT what a
        scheduler has told all processes by SIGTERM. Output that nobody reads any more requests the stop too: a session
        that is lost need not send a signal.
        """
        received: set[int] = set()

        def handle(number: int, frame: FrameType | None) -> None:
            if number == signal.SIGINT and number in received:
                raise Signalled(number)
            received.add(number)
            self.set("interrupted", exit_status=status_after(number))

        self._take_signals(handle)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # under nohup, output may go away
            on_output_gone(lambda: self.set("interrupted", exit_status=status_after(signal.SIGPIPE)))

    def _take_signals(self, handler: Handler) -> None:
        self._handler = handler
        if threading.current_thread() is threading.main_thread():
            _handle(handler)

    def raise_for_status(self) -> None:
        """End the process with the status that the stop requires; return if that is 0.

        Raises:
            PeerLost: the stop is a failure.
            ProcessExit: a signal caused the stop; schedulers must not mistake this for completed work.
        """
        if self.failed:
            raise PeerLost(self.reason)
        if self.exit_status:
            raise ProcessExit(self.exit_status)

    def on_thread_failures(self) -> None:
        """Stop the process when an uncaught exception ends one of its threads."""

        def handle(failure: threading.ExceptHookArgs) -> None:
            threading.__excepthook__(failure)  # prints the traceback
            name = failure.thread.name if failure.thread is not None else "?"
            self.set(f"error of this program in the thread {name!r}: {first_line(failure.exc_value)}", failed=True)

        threading.excepthook = handle


def status_after(number: int) -> int:
    """The exit status of a process that a signal ended."""
    return 128 + number


def end_on_signals(program: str) -> None:
    """Make a signal end this process at once, as long as nothing else has taken over."""

    def handle(number: int, frame: FrameType | None) -> None:
        # Not by an exception: a module that is being imported may swallow it.
        with suppress(OSError):
            os.write(2, f"{program}: interrupted\n".encode())
        os._exit(status_after(number))

    _handle(handle)


def raise_on_signals() -> None:
    """Make a signal raise `Signalled`: for commands that hold no state, but children and half-written files."""

    def handle(number: int, frame: FrameType | None) -> None:
        raise Signalled(number)

    _handle(handle)


def _handle(handler: Handler) -> None:
    """Handle the signals that end a process; not SIGHUP where nohup has it ignored."""
    for number in SIGNALS:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def run_main(program: str, main: Callable[[], None]) -> None:
    """Run a command's body; end with one line, and its status, for whatever it raises.

    What is no CoopError and no failure of a file or of memory is printed with its traceback before that line.
    """
    status: int | None = None
    try:
        main()
    except ProcessExit as error:
        status = error.code if isinstance(error.code, int) else 0
    except KeyboardInterrupt as error:
        complain(f"{program}: interrupted")
        status = getattr(error, "exit_status", status_after(signal.SIGINT))
    except BaseException as error:
        line, status = _explained(error)
        complain(f"{program}: error: {line}")
    finally:
        flush_at_end()
    if status is not None:
        sys.exit(status)


def _explained(error: BaseException) -> tuple[str, int]:
    """The line that tells a user of a failure, and its exit status; prints the traceback if the line is not enough."""
    match error:
        case CoopError():
            return str(error), error.exit_status
        case SystemExit():
            code = "" if error.code is None else repr(error.code)
            return f"sys.exit({code}) was called {_where(error)}; only this program ends its processes", 1
        case OSError() if line := _of_a_file(error):
            return line, 1
    if line := out_of_memory(error):
        return line, 1
    if changed := _torch_defaults():
        return (
            f"{first_line(error)}; users' code has set {changed}, which this program's own networks need as it was",
            1,
        )
    traceback.print_exception(error)
    return first_line(error) + place(error), 1


def _torch_defaults() -> str:
    """What somebody has set of PyTorch's defaults, which this program leaves alone; empty if nothing."""
    if (torch := sys.modules.get("torch")) is None:
        return ""
    device, dtype = torch.get_default_device().type, torch.get_default_dtype()
    found = {"device": "" if device == "cpu" else device, "dtype": "" if dtype == torch.float32 else str(dtype)}
    return " and ".join(f"torch's default {name} to {value}" for name, value in found.items() if value)


def _of_a_file(error: OSError) -> str:
    """The line of a failure that a file explains; empty for another one."""
    match error:
        case OSError(errno=number) if number in NO_SPACE:
            return f"{error.filename or 'output'}: {error.strerror}"
        case OSError(filename=str() | bytes() as name, strerror=str() as why):
            return f"{os.fsdecode(name)}: {why}"
        case OSError(errno=errno.EBADF):
            return f"a file that this process had open has been closed ({error}); does users' code close descriptors?"
    return ""


def out_of_memory(error: BaseException) -> str:
    """The line of an error by which the system has refused memory or a process; empty for another one.

    PyTorch, and the loader of libraries, say so in words.
    """
    processes = _says(error, _OUT_OF_PROCESSES)
    refused = isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
    if not (processes or refused or _says(error, _OUT_OF_MEMORY)):
        return ""
    more = " and processes (ulimit -u)" if processes else ""
    return f"not enough memory{more} ({first_line(error)}); {memory_limit()}"


def _says(error: BaseException, phrases: tuple[tuple[type[BaseException], str], ...]) -> bool:
    return any(isinstance(error, kind) and words in text_of(error) for kind, words in phrases)


def _where(error: BaseException) -> str:
    """Where an exception was raised, in words."""
    frames = traceback.extract_tb(error.__traceback__)
    return f"in {frames[-1].name}, line {frames[-1].lineno} of {frames[-1].filename}" if frames else "somewhere"


@contextmanager
def despite_threads() -> Iterator[None]:
    """Run a command's body within it, and end the process even if a thread of users' code, not a daemon, does not."""
    status: object = 0
    try:
        yield
    except SystemExit as end:
        status = end.code
        if not _left():
            raise
    ends = time.monotonic() + LEFT
    for thread in _left():
        thread.join(max(0.0, ends - time.monotonic()))
    if not (left := _left()):
        sys.exit(status)  # type: ignore[arg-type] # of the SystemExit
    warn(f"the thread {left[0].name!r} has not ended; this process ends without it")
    atexit._run_exitfuncs()  # as the interpreter would
    flush_at_end()
    os._exit(status if isinstance(status, int) else int(status is not None))


def _left() -> list[threading.Thread]:
    """The threads that the interpreter would wait for, without the idle ones of executors, which it ends."""
    return [
        thread
        for thread in threading.enumerate()
        if not thread.daemon
        and thread is not threading.main_thread()
        and getattr(getattr(thread, "_target", None), "__module__", "") != "concurrent.futures.thread"
    ]
