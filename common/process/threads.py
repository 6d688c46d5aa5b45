"""The threads of a process: how many its arithmetic has, and those that users' code leaves behind."""

from __future__ import annotations

import atexit
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from threadpoolctl import threadpool_limits

from common.process.notices import warn

LEFT = 2.0  # seconds for threads to end by themselves


def use_threads(count: int) -> None:
    """Limit numpy's BLAS and, if it has been imported, PyTorch to `count` threads; by default both use every core."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(count)
    threadpool_limits(count, user_api="blas")


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
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
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
