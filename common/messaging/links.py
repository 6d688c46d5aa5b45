"""A session's links: where it listens, how many it may have, how it closes; no other one must block them.

Zenoh sets SO_LINGER to 10 s on its sockets. If a peer freezes or its cable is cut while data is unsent, Zenoh's closing
thread blocks for that long, and since all links share this thread, no other peer can send or receive meanwhile. Zenoh
has no setting for it, so this module switches lingering off on each new link's socket. Zenoh does not tell which one
that is, so all are looked at: once for all links that come within a moment, as a thousand actors may join at once.

A TLS listener of Zenoh waits for 0.1 s after each handshake that fails, also by the silence of its client, and takes no
other client meanwhile; it has no setting for that either. So the kernel keeps connections to itself until their clients
have sent something (`wait_for_words`). Zenoh never learns of one that says nothing, nor of its end.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import socket
import stat
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zenoh

PATIENCE = 1.0  # seconds for threads to end once the last session is closed
PAUSE = 0.2  # seconds between looks at this process's sockets, far less than a peer's lease
_CALLBACKS = "(pyo3-closure)"  # ends the names of the threads in which Zenoh calls back
_LINGER_OFF = struct.pack("ii", 0, 0)
SILENCE = 3600  # seconds for which a connection may say nothing before the kernel hands it on all the same
WAITING = 1 << 16  # connections that may wait so, as far as the system permits (net.core.somaxconn)
_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
# Filters of the listening socket's segments, as (code, jump if true, jump if false, operand) of classic BPF; byte 0 is
# the TCP header's first. They drop what would hand a connection on that has nothing to say: an end without words, and
# at a TLS listener also a ClientHello that is not all there, unless it is longer than a segment may be.
_A_HELLO = 512  # bytes: what each link carries in one segment
_WORDS = (  # of a segment: the header's length to X, that of the rest to A
    (0x30, 0, 0, 12),
    (0x74, 0, 0, 4),
    (0x64, 0, 0, 2),  # four-byte words in bytes
    (0x07, 0, 0, 0),
    (0x80, 0, 0, 0),
    (0x1C, 0, 0, 0),
)
_END = (
    (0x30, 0, 0, 13),  # load the flags
    (0x54, 0, 0, 1),  # FIN alone
    (0x15, 0, 1, 0),  # set: drop
    (0x06, 0, 0, 0xFFFFFFFF),  # keep
    (0x06, 0, 0, 0),  # drop
)
_HELLO = (
    (0x02, 0, 0, 0),  # store the length of the words
    (0x50, 0, 0, 0),  # their first byte:
    (0x15, 0, 14, 0x16),  # another than a handshake's: keep
    (0x60, 0, 0, 0),
    (0x35, 0, 13, 6),  # too short to say which one: drop
    (0x50, 0, 0, 5),
    (0x15, 0, 10, 1),  # no ClientHello: keep
    (0x60, 0, 0, 0),
    (0x35, 8, 0, _A_HELLO),  # keep
    (0x48, 0, 0, 3),  # load the record's length
    (0x04, 0, 0, 5),  # with its header
    (0x07, 0, 0, 0),
    (0x60, 0, 0, 0),
    (0x3D, 3, 4, 0),  # not all there: drop
)
_FILTERS = {
    "tcp": (*_WORDS, (0x15, 0, 3, 0), *_END),  # words: keep
    "tls": (*_WORDS, (0x15, len(_HELLO), 0, 0), *_HELLO, *_END),
}


def described(session: zenoh.Session, mode: str = "peer") -> dict[str, Any]:
    """What Zenoh's administration says of this session, whose mode is given; empty if it does not answer."""
    for reply in session.get(f"@/{session.zid()}/{mode}", timeout=2.0):
        if reply.ok is not None:
            answer: dict[str, Any] = json.loads(reply.ok.payload.to_string())
            return answer
    return {}


def locators(session: zenoh.Session) -> list[str]:
    """The endpoints that this session listens on, with a port of 0 resolved."""
    return [str(locator) for locator in described(session).get("locators", ())]


def permit_many() -> None:
    """Raise this process's limit of descriptors, of which each link takes one, as far as the system permits."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


class _Instruction(ctypes.Structure):
    _fields_ = (("code", ctypes.c_ushort), ("yes", ctypes.c_ubyte), ("no", ctypes.c_ubyte), ("k", ctypes.c_uint))


def wait_for_words(session: zenoh.Session, mode: str) -> None:
    """Make the kernel keep new TCP connections to a session until their clients have sent something.

    Of TLS, what begins a handshake: all of a ClientHello.
    """
    places = (str(at).partition("/") for at in described(session, mode).get("locators", ()))
    ports = {int(at.rpartition(":")[2]): _FILTERS[protocol] for protocol, _, at in places if protocol in _FILTERS}
    for opened in _tcp_sockets():
        with contextlib.suppress(OSError, KeyError):  # a kernel without these, another's port
            if _listens(opened):
                filters = ports[opened.getsockname()[1]]
                program = (_Instruction * len(filters))(*(_Instruction(*each) for each in filters))
                packed = struct.pack("HP", len(program), ctypes.addressof(program))
                opened.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, packed)
                opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, SILENCE)
                opened.listen(WAITING)


def _listens(opened: socket.socket) -> bool:
    return bool(opened.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN))


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
    """Switch SO_LINGER off on every TCP connection of this process, and the filter that it has from its listener."""
    for opened in _tcp_sockets():
        if not _listens(opened):
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_OFF)
            with contextlib.suppress(OSError):  # it has none
                opened.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)


def _tcp_sockets() -> Iterator[socket.socket]:
    """Every TCP socket of this process, each open until the next one is asked for."""
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
                yield opened
