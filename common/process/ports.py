"""Where a process serves HTTP: a port, on loopback unless a host is named."""

from __future__ import annotations

import re
import socket

from coop.common.errors import RunError, UsageError

LOOPBACK = "127.0.0.1"
CONNECTING = 5.0  # seconds


def check_loopback() -> None:
    """Raise RunError where processes of this machine can't connect to each other: no time would make them."""
    with socket.socket() as listening:
        try:
            listening.bind((LOOPBACK, 0))
            listening.listen()
            socket.create_connection(listening.getsockname(), CONNECTING).close()
        except OSError as error:
            problem = error.strerror or error
            raise RunError(
                f"this machine's loopback interface can't be used ({LOOPBACK}: {problem}), by which the processes of a "
                "run reach each other; ip link set lo up"
            ) from error


def http_address(flag: str, text: str) -> tuple[str, int]:
    """The host and port of PORT or HOST:PORT, as the flag was given; raises UsageError."""
    found = re.fullmatch(r"(?:(?P<host>[^:\s]+|\[[0-9A-Fa-f:.]+\]):)?(?P<port>\d{1,5})", text)
    if found is None or int(found["port"]) >= 2**16:
        raise UsageError(f"{flag} {text}: PORT or HOST:PORT with a port from 0 to 65535 is needed")
    return (found["host"] or LOOPBACK).strip("[]"), int(found["port"])


def family(host: str) -> socket.AddressFamily:
    """How a host of `http_address` is written."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def check_can_listen(flag: str, text: str) -> None:
    """Raise UsageError where PORT or HOST:PORT, as the flag was given, can't be listened on."""
    host, port = http_address(flag, text)
    with socket.socket(family(host)) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do: closed connections don't count
        try:
            trial.bind((host, port))
        except OSError as error:
            raise UsageError(f"{flag} {text}: {error.strerror or error}") from error
