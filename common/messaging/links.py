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
from pathlib import Path
from typing import Any

import zenoh

PATIENCE = 1.0  # seconds for a thread to end once its session is closed
PAUSE = 0.2  # seconds between looks at this process's sockets, far less than a peer's lease
_LINGER_OFF = struct.pack("ii", 0, 0)
_followers: dict[str, tuple[threading.Thread, threading.Event]] = {}  # by the session's id


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


def never_linger(session: zenoh.Session) -> None:
    """Make Zenoh close all present and future links of this session at once; the kernel still delivers what it can."""
    changes = session.info.declare_link_events_listener(zenoh.handlers.RingChannel(1), history=True)
    closing = threading.Event()
    thread = threading.Thread(target=_follow, args=(changes, closing), name="links", daemon=True)
    _followers[str(session.zid())] = thread, closing
    thread.start()


def _follow(changes: Any, closing: threading.Event) -> None:  # noqa: ANN401 (zenoh's listener)
    """Treat the sockets after each change of the links, and at most every `PAUSE` seconds, until the session closes."""
    with contextlib.suppress(zenoh.ZError):
        while not closing.is_set():
            changes.recv()
            _linger_off()
            closing.wait(PAUSE)


def close(session: zenoh.Session) -> None:
    """Close a session; takes up to 10 s while it connects to a host that does not answer."""
    thread, closing = _followers.pop(str(session.zid()), (None, None))
    if closing is not None:
        closing.set()
    with contextlib.suppress(zenoh.ZError):  # it then says that it took too long
        session.close()  # type: ignore[no-untyped-call]
    if thread is not None:
        thread.join(PATIENCE)  # a thread that comes back from Zenoh while the interpreter ends would abort the process


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
