"""Cuts the link between two hosts under load: `python benchmarks/netns.py --cut 20` (root).

The hosts are network namespaces joined by a veth pair: learner and replay service in one, actors in the other. The link
is cut at one end, and in another run at the other end. Each time every role must work again within 5 s after its
return, and the table must hold every step once. Otherwise the exit status is 1.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from audit import audit
from roles import ActorWatch, Roles, replay_stats, running, wait_until

from common.errors import CoopError, RunError
from common.messaging.transport import Node, new_incarnation, open_session

RUN = "netns"
ACTORS = 2
WITHIN = 5.0  # seconds after the link's return
LOAD = 5.0  # seconds of work before and after the cut
HEAD, FAR = "198.18.0.1", "198.18.0.2"
AT = f"tcp/{HEAD}:7447", f"tcp/{HEAD}:7448"
LINK = "wire"  # the veth pair's name at both ends
INSIDE = "COOP_NETNS"  # set in the process that runs inside the head's namespace: the two namespaces' names


def ip(*words: str) -> None:
    """Run `ip`; raises RunError with its error message."""
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RunError(f"ip {' '.join(words)}: {done.stderr.strip()}")


@contextmanager
def two_hosts() -> Iterator[tuple[str, str]]:
    """Make two connected namespaces; yields their names."""
    head, far = names = f"coop-head-{os.getpid()}", f"coop-far-{os.getpid()}"
    try:
        for name in names:
            ip("netns", "add", name)
        ip("-n", head, "link", "add", LINK, "type", "veth", "peer", "name", LINK, "netns", far)
        for name, address in zip(names, (HEAD, FAR), strict=True):
            ip("-n", name, "addr", "add", f"{address}/30", "dev", LINK)
            for device in ("lo", LINK):
                ip("-n", name, "link", "set", device, "up")
        yield head, far
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)


def cut_and_mend(folder: Path, end: str, host: str, far: str, seconds: float) -> None:
    """Inside the head's namespace, cut the link at one end; raises a CoopError if a check fails."""
    flags = ("--preset=cartpole", "--total-steps=100000000", "--replay.capacity=200000")
    roles = Roles(folder, RUN, AT, flags, ACTORS, lambda role: ["ip", "netns", "exec", far] if role == "actor" else [])
    with (
        running(roles),
        Node(open_session((), AT), RUN, "watch", new_incarnation()) as node,
        ActorWatch(RUN, AT[0]) as actors,
    ):
        wait_until("every actor at work", lambda: len(actors.acked()) == ACTORS and min(actors.acked().values()) > 0)
        before = replay_stats(node).inserted
        time.sleep(LOAD)
        rate = (replay_stats(node).inserted - before) / LOAD
        ip("-n", host, "link", "set", LINK, "down")
        time.sleep(seconds)
        roles.check(*roles.processes)
        held, stats = actors.acked(), replay_stats(node)
        ip("-n", host, "link", "set", LINK, "up")

        def at_work() -> bool:
            now, acked = replay_stats(node), actors.acked()
            return now.drawn > stats.drawn and all(acked[actor] > held[actor] for actor in held)

        back = wait_until("everybody's return", at_work)
        before = replay_stats(node).inserted
        time.sleep(LOAD)
        again = (replay_stats(node).inserted - before) / LOAD

        summary = roles.finish()
    (gaps, twice), refused = audit(folder), summary["duplicates_refused"]
    lost = gaps + summary["transitions_lost"]
    print(
        f"cut at the {end}'s end for {seconds:g} s at {rate:.0f} steps/s; all at work again {back:.1f} s after the "
        f"link, at {again:.0f} steps/s; of {summary['transitions_accepted']:,} transitions lost {lost}, "
        f"duplicated {twice} ({refused} second deliveries refused)",
        flush=True,
    )
    if lost or twice:
        raise RunError("transitions were lost or duplicated")
    if back > WITHIN:
        raise RunError(f"not back within {WITHIN:g} s")


def main() -> None:
    """Make the hosts, and run this script inside the first one."""
    parser = argparse.ArgumentParser(description="Cut the link between two hosts under load.")
    parser.add_argument("--cut", type=float, default=20.0, help="seconds")
    seconds = parser.parse_args().cut
    if os.geteuid() or shutil.which("ip") is None:
        print("netns: skipped: making network namespaces needs root and iproute2")
        return
    try:
        if INSIDE in os.environ:
            head, far = os.environ[INSIDE].split()
            for end, host in (("learner", head), ("actor", far)):
                with tempfile.TemporaryDirectory() as folder:
                    cut_and_mend(Path(folder) / "run", end, host, far, seconds)
            return
        with two_hosts() as names:
            again = [*("ip", "netns", "exec", names[0], sys.executable), *sys.argv]
            sys.exit(subprocess.run(again, env={**os.environ, INSIDE: " ".join(names)}, check=False).returncode)
    except CoopError as error:
        sys.exit(f"netns: error: {error}")


if __name__ == "__main__":
    main()
