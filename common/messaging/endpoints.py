"""Checks endpoints that users write, and explains invalid ones."""

from __future__ import annotations

import errno
import os
import re
import socket
from collections.abc import Sequence

from coop.common.errors import UsageError

PORTS = ("tcp", "tls", "udp", "quic", "ws")  # protocols whose address is HOST:PORT
OTHERS = ("unixsock-stream", "unixpipe", "serial", "vsock")
_OS_ERROR = re.compile(r"os error (\d+)", re.IGNORECASE)
_WORDS = {
    errno.EADDRINUSE: "the port is in use",
    errno.EADDRNOTAVAIL: "this machine does not have that address",
    errno.EACCES: "not permitted",
}


def check_endpoints(endpoints: Sequence[str]) -> None:
    """Raise UsageError for the first endpoint that is not PROTOCOL/ADDRESS, with a suggestion."""
    for endpoint in endpoints:
        protocol, slash, address = endpoint.partition("/")
        if not slash:
            raise UsageError(f"endpoint {endpoint!r}: no protocol; did you mean tcp/{endpoint or 'HOST:PORT'}?")
        if protocol.endswith(":"):
            raise UsageError(f"endpoint {endpoint!r}: did you mean {protocol[:-1]}/{address.lstrip('/')}?")
        if protocol not in PORTS + OTHERS:
            allowed = ", ".join(PORTS + OTHERS)
            raise UsageError(f"endpoint {endpoint!r}: no such protocol as {protocol!r}; allowed: {allowed}")
        if protocol in PORTS:
            host, port = _host_and_port(address)
            if not (host and port.isdecimal() and int(port) < 2**16):
                raise UsageError(f"endpoint {endpoint!r}: {protocol}/HOST:PORT with a port from 0 to 65535 is needed")


def on_loopback(endpoints: Sequence[str]) -> bool:
    """Whether one of `endpoints` is a port of this machine's loopback interface."""
    hosts = [_host_and_port(endpoint.partition("/")[2])[0] for endpoint in endpoints]
    return any(host == "localhost" or host.startswith("127.") for host in hosts)


def unknown_hosts(endpoints: Sequence[str]) -> list[str]:
    """Names of hosts in `endpoints` that cannot be resolved now."""
    unknown = []
    for endpoint in endpoints:
        protocol, _, address = endpoint.partition("/")
        host, _ = _host_and_port(address)
        try:
            if protocol in PORTS:
                socket.getaddrinfo(host, None)
        except (socket.gaierror, UnicodeError):
            unknown.append(host)
    return unknown


def explain_listen_error(listen: Sequence[str], error: Exception) -> str:
    """Explain why Zenoh, which raised `error`, cannot listen."""
    if hosts := unknown_hosts(listen):
        return f"the host {hosts[0]!r} is not known"
    found = _OS_ERROR.search(str(error))
    if found is None:
        return zenoh_reason(error)
    number = int(found[1])
    return _WORDS.get(number, os.strerror(number).lower())


def explain_shared_memory(error: Exception) -> str:
    """Explain an error of Zenoh's about its shared memory; empty if it is about something else."""
    if "shm" not in str(error).lower():
        return ""
    found = _OS_ERROR.search(str(error))
    return f"--shared-memory: /dev/shm: {os.strerror(int(found[1])).lower() if found else zenoh_reason(error)}"


def zenoh_reason(error: Exception) -> str:
    """The text of Zenoh's error without its source locations, in one line."""
    lines = str(error).split(" at /")[0].splitlines()
    if lines[0].startswith(" --> "):  # the place in a file, the line there, and at last what is wrong with it
        return f"line {lines[0].removeprefix(' --> ')}: {lines[-1].strip(' =')}"
    return lines[0]


def _host_and_port(address: str) -> tuple[str, str]:
    host, _, port = re.split("[?#]", address)[0].rpartition(":")
    return host.strip("[]"), port
