"""Hosts on this machine: network namespaces with addresses of their own, joined by a switch (root, iproute2).

Every host has an IPv4 and an IPv6 address, and a file of host names, which `ip netns exec` shows it as /etc/hosts.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from coop.common.errors import RunError

WIRE = "wire"  # a host's interface; the other end, in the switch, has the host's name
BRIDGE = "bridge0"
INSIDE = "COOP_NETNS"  # set in a script that runs inside the first host's namespace: the network's number
NAMES = Path("/etc/netns")  # NAMESPACE/hosts: the host names that processes in the namespace know


def ip(*words: str) -> None:
    """Run `ip`; raises RunError with its error message."""
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RunError(f"ip {' '.join(words)}: {done.stderr.strip()}")


class Host:
    """A host: its name, and its number in the network, the last part of its addresses."""

    def __init__(self, network: int, name: str, number: int) -> None:
        self.name = name
        self.number = number
        self.namespace = f"coop-{network}-{name}"
        self.inside = ["ip", "netns", "exec", self.namespace]
        self._switch = _switch(network)

    def address(self, family: int) -> str:
        """Its address; family: 4 or 6."""
        return f"198.18.0.{self.number}" if family == 4 else f"fd00:198:18::{self.number}"

    def plug_in(self) -> None:
        """Make its interface, join it to the switch and put it up."""
        port = ("link", "add", self.name, "type", "veth", "peer", "name", WIRE, "netns", self.namespace)
        ip("-n", self._switch, *port)
        ip("-n", self._switch, "link", "set", self.name, "master", BRIDGE, "up")
        self.up()

    def unplug(self) -> None:
        """Remove its interface and all addresses; its peers get no word of it."""
        ip("-n", self.namespace, "link", "delete", WIRE)

    def up(self) -> None:
        """Put its interface up, with its addresses: `down` takes the one of IPv6."""
        ip("-n", self.namespace, "link", "set", WIRE, "up")
        for address in (f"{self.address(4)}/24", f"{self.address(6)}/64"):
            ip("-n", self.namespace, "address", "replace", address, "dev", WIRE, "nodad")

    def down(self) -> None:
        """Cut it off."""
        ip("-n", self.namespace, "link", "set", WIRE, "down")


def hosts_of(network: int, names: Sequence[str]) -> dict[str, Host]:
    """The hosts of a network by name, as they were made."""
    return {name: Host(network, name, number) for number, name in enumerate(names, 1)}


def write_names(hosts: dict[str, Host], family: int) -> None:
    """Tell every host the names of all; family: of the addresses behind them. Running processes meet the new file."""
    lines = ["127.0.0.1 localhost", *(f"{host.address(family)} {host.name}" for host in hosts.values())]
    for host in hosts.values():
        (NAMES / host.namespace / "hosts").write_text("\n".join(lines) + "\n", encoding="utf-8")


@contextmanager
def network_of(number: int, names: Sequence[str]) -> Iterator[dict[str, Host]]:
    """Make a network of hosts, and remove it at the end; number: of the network, unique on this machine."""
    hosts, switch = hosts_of(number, names), _switch(number)
    ours = not NAMES.exists()
    try:
        ip("netns", "add", switch)
        ip("-n", switch, "link", "add", "name", BRIDGE, "type", "bridge")
        ip("-n", switch, "link", "set", BRIDGE, "up")
        for host in hosts.values():
            (NAMES / host.namespace).mkdir(parents=True)
            ip("netns", "add", host.namespace)
            ip("-n", host.namespace, "link", "set", "lo", "up")
            host.plug_in()
        write_names(hosts, 4)
        yield hosts
    finally:
        for namespace in (switch, *(host.namespace for host in hosts.values())):
            subprocess.run(["ip", "netns", "delete", namespace], capture_output=True, check=False)
        for host in hosts.values():
            (NAMES / host.namespace / "hosts").unlink(missing_ok=True)
            if (NAMES / host.namespace).exists():
                (NAMES / host.namespace).rmdir()
        if ours and NAMES.exists():
            NAMES.rmdir()


def inside_the_first(names: Sequence[str], script: Callable[[dict[str, Host]], None]) -> None:
    """Make a network of hosts, and call `script` with them in another process of this program, on the first host.

    Without root or iproute2 it says so, and skips. Ends with that process's status.
    """
    if os.geteuid() or shutil.which("ip") is None:
        print("SKIP: making network namespaces needs root and iproute2")
    elif INSIDE in os.environ:
        script(hosts_of(int(os.environ[INSIDE]), names))
    else:
        with network_of(os.getpid(), names) as hosts:
            again = [*hosts[names[0]].inside, sys.executable, *sys.argv]
            sys.exit(subprocess.run(again, env={**os.environ, INSIDE: str(os.getpid())}, check=False).returncode)


def _switch(network: int) -> str:
    return f"coop-{network}-switch"
