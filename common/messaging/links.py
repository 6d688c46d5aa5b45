"""A session's links: where it listens, how many it may have, how it closes; a dead one must not block the others.

Zenoh sets SO_LINGER to 10 s on its sockets. If a peer freezes or its cable is cut while data is unsent, Zenoh's closing
thread blocks for that long, and since all links share this thread, no other peer can send or receive meanwhile. Zenoh
has no setting for it, so this module switches lingering off on each new link's socket. Zenoh does not tell which one
that is, so all are looked at: once for all links that come within a moment, as a thousand actors may join at once.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import socket
import stat
import struct
import threading
import time
from pathlib import Path
from typing import Any

import zenoh

PATIENCE = 1.0  # seconds for threads to end once the last session is closed
PAUSE = 0.2  # seconds between looks at this process's sockets, far less than a peer's lease
_CALLBACKS = "(pyo3-closure)"  # ends the names of the threads in which Zenoh calls back
_LINGER_OFF = struct.pack("ii", 0, 0)


def described(session: zenoh.Session, mode: str = "peer") -> dict[str, Any]:
    """What Zenoh's administration says of this session, whose mode is given; empty if it does not answer."""
    for reply in session.get(f"@/{session.zid()}/{mode}", timeout=2.0):
        if reply.ok is not None:
            told: dict[str, Any] = json.loads(reply.ok.payload.to_string())
            return told
    return {}


def locators(session: zenoh.Session) -> list[str]:
    """The endpoints that this session listens on, with a port of 0 resolved."""
    return [str(locator) for locator in described(session).get("locators", ())]


def permit_many() -> None:
    """Raise this process's limit of descriptors, of which each link takes one, as far as the system permits."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


class _Follower:
    """Treats the sockets where a session's links have changed, which it looks for every `PAUSE` seconds.

    One thread for all sessions of the process, from the first one's opening to the last one's closing. Zenoh does not
    call back, because the thread that carries the links would then wait for Python's lock.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._listeners: dict[str, Any] = {}  # by the session's id
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def add(self, session: zenoh.Session) -> None:
        """Follow a session's links."""
        listener = session.info.declare_link_events_listener(zenoh.handlers.RingChannel(1), history=True)
        with self._lock:
            self._listeners[str(session.zid())] = listener
            if self._thread is None:
                self._closing.clear()
                self._thread = threading.Thread(target=self._run, name="links", daemon=True)
                self._thread.start()

    def drop(self, identity: str) -> None:
        """Forget a session; with the last one, end the thread, and wait for those of Zenoh."""
        with self._lock:
            listener = self._listeners.pop(identity, None)
            if listener is not None:
                listener.undeclare()
            if self._listeners or self._thread is None:
                return
            self._closing.set()
            self._thread.join(PATIENCE)
            self._thread = None
        _await_callbacks()

    def _run(self) -> None:
        while not self._closing.wait(PAUSE):
            if sum(map(_has_changed, tuple(self._listeners.values()))):  # of each, so that none is seen as new again
                _linger_off()


_follower = _Follower()


def never_linger(session: zenoh.Session) -> None:
    """Make Zenoh close all present and future links of this session at once; the kernel still delivers what it can."""
    _follower.add(session)


def close(session: zenoh.Session) -> None:
    """Close a session; takes up to 10 s while it connects to a host that does not answer."""
    identity = str(session.zid())
    with contextlib.suppress(zenoh.ZError):  # it then says that it took too long
        session.close()  # type: ignore[no-untyped-call]
    _follower.drop(identity)


def _await_callbacks() -> None:
    """Wait for the threads in which Zenoh called back: they end a moment after their session is closed.

    Python ends those that remain when it exits by unwinding their stack, which Zenoh's code answers with SIGABRT.
    """
    deadline = time.monotonic() + PATIENCE
    for thread in threading.enumerate():
        if thread.name.endswith(_CALLBACKS):
            thread.join(max(0.0, deadline - time.monotonic()))


def _has_changed(listener: Any) -> bool:  # noqa: ANN401 (zenoh's)
    """Whether a session's links have changed since the last look."""
    with contextlib.suppress(zenoh.ZError):  # its session is being closed
        return listener.try_recv() is not None
    return False


def _linger_off() -> None:
    """Switch SO_LINGER off on every TCP socket of this process."""
    for entry in Path("/proc/self/fd").iterdir():
        try:
            own = os.dup(int(entry.name))
        except OSError:
            continue  # closed since it was listed
        if not stat.S_ISSOCK(os.fstat(own).st_mode):
            os.close(own)
            continue
        with socket.socket(fileno=own) as opened:
            if opened.type == socket.SOCK_STREAM and opened.family in (socket.AF_INET, socket.AF_INET6):
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_OFF)
