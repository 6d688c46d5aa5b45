"""Opens Zenoh sessions: explicit endpoints, no scouting, quick reconnection, as many links as the system permits."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import zenoh

from coop.common.bounds import MAX_PAYLOAD
from coop.common.errors import RunError, UsageError
from coop.common.messaging.endpoints import (
    check_endpoints,
    explain_listen_error,
    explain_shared_memory,
    on_loopback,
    zenoh_reason,
)
from coop.common.messaging.links import never_linger, permit_many, wait_for_words
from coop.common.messaging.timing import LEASE
from coop.common.messaging.transport import NoAnswer
from coop.common.process.ports import check_loopback

MAX_LINKS = 1 << 16  # of a session; Zenoh's own limit is 1,000
LONG_QUEUE, SHORT_QUEUE = 16, 4  # parts of messages, of 64 KiB each, that a link keeps memory for once it has sent them
# Left to itself Zenoh wakes one thread after another for each part of a message: the one that accepts links waits for
# their sockets, and others receive and send. It reads the variable when a process opens its first session.
THREADS = "ZENOH_RUNTIME"
RECEIVING = "(rx:(handover:acc),net:(handover:acc))"  # one thread waits and receives, another sends
CONNECTING = "(rx:(handover:acc),net:(handover:acc),tx:(handover:acc))"  # one thread does it all

_QUIET = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "adminspace/enabled": True,
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
    "listen/exit_on_failure": True,
    "transport/unicast/max_sessions": MAX_LINKS,
    "transport/unicast/accept_timeout": 5000,  # milliseconds to open a session once connected
    "transport/unicast/accept_pending": 1024,  # sessions that are being opened; one more is refused
    "transport/link/tx/lease": round(1000 * LEASE),
    "transport/link/rx/max_message_size": MAX_PAYLOAD + (1 << 16),
    "transport/shared_memory/enabled": False,
}


def open_session(
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    zenoh_config: Path | None = None,
    shared_memory: bool = False,
    mode: str = "peer",
    send_queue: int = LONG_QUEUE,
) -> zenoh.Session:
    """Open a session with explicit endpoints, no scouting and quick reconnection.

    mode: "peer"; "router", which forwards between others; "client", which has one link, to a router.
    send_queue: `SHORT_QUEUE` saves memory where there are many links; batches leave faster with `LONG_QUEUE`.

    Raises:
        UsageError: a Zenoh config file or an endpoint is invalid.
        RunError: it cannot listen on an endpoint, for example because the port is in use; or an endpoint is on a
            loopback interface that this machine lacks.
        NoAnswer: mode is "client", and no router has answered within a second.
    """
    zenoh.init_log_from_env_or("off")
    check_endpoints((*listen, *connect))
    if on_loopback((*listen, *connect)):
        check_loopback()
    if listen:
        permit_many()
    try:
        config = zenoh.Config.from_file(str(zenoh_config)) if zenoh_config else zenoh.Config()
        for key, value in _QUIET.items():
            config.insert_json5(key, json.dumps(value))
        config.insert_json5("mode", json.dumps(mode))
        config.insert_json5("transport/shared_memory/enabled", json.dumps(shared_memory))
        config.insert_json5("transport/link/tx/queue/size/data", str(send_queue))
        config.insert_json5("listen/endpoints", json.dumps(list(listen)))
        config.insert_json5("connect/endpoints", json.dumps(list(connect)))
        config.insert_json5("connect/timeout_ms", "1000" if mode == "client" else "-1")  # a client waits for its link
    except zenoh.ZError as error:
        name = f"--zenoh-config {zenoh_config}" if zenoh_config else "zenoh configuration"
        raise UsageError(f"{name}: {zenoh_reason(error)}") from error
    try:
        with _threads(mode, listens=bool(listen)):
            session = zenoh.open(config)
    except zenoh.ZError as error:
        if shared_memory and (problem := explain_shared_memory(error)):
            raise RunError(problem) from error
        if mode == "client":
            raise NoAnswer(f"no router at {', '.join(connect)}") from error
        raise RunError(
            f"can't listen on {', '.join(listen) or 'any endpoint'}: {explain_listen_error(listen, error)}"
        ) from error
    never_linger(session)
    if listen:
        wait_for_words(session, mode)
    return session


@contextmanager
def _threads(mode: str, *, listens: bool) -> Iterator[None]:
    """Let fewer of Zenoh's threads carry this process's links, unless the user says how many.

    What others connect to sends in a thread of its own: it answers many, and must not wait for one whose link is full
    in the thread that would empty it. A router, which sends on what it receives, keeps all threads.
    """
    if mode == "router" or THREADS in os.environ:
        yield
        return
    os.environ[THREADS] = RECEIVING if listens else CONNECTING
    try:
        yield
    finally:
        os.environ.pop(THREADS, None)  # a router that this process starts would inherit it
