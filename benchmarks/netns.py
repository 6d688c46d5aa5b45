"""Cuts hosts of a run from the network, and reboots one, under load: `python benchmarks/netns.py` (root).

The hosts are network namespaces: one with the learner, one with the replay service, two with an actor each. Each
scenario is a run of its own, by addresses or by host names, over IPv4 or IPv6. Every role must work again soon after
what was cut or killed has returned, the run must complete, and its table must hold every step once. Otherwise the exit
status is 1.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from audit import audit
from hosts import Host, inside_the_first, write_names
from roles import Roles, RunWatch, running, wait_until

from coop.common.errors import CoopError, RunError
from coop.common.process.processes import command

RUN = "netns"
PLACES = {"learner": "head", "replay": "rep", "actor 1": "act1", "actor 2": "act2"}
LEARNER_PORT, REPLAY_PORT = 7447, 7448
LOAD = 3.0  # seconds of work before and after
STEPS = 16_000  # of a run, so that it is still on when a cut ends
RATIO, CLOSING_RATIO = "2", "0.1"  # updates per step: few steps pass during a scenario, and the rest soon after it


class Trial:
    """A run on the hosts.

    Args:
        family: 4 or 6. named: whether hosts are named to each other by their names, not by their addresses.
    """

    def __init__(self, folder: Path, hosts: dict[str, Host], family: int, named: bool) -> None:
        self.hosts = hosts
        self.port = REPLAY_PORT
        self._folder, self._family, self._named = folder, family, named
        self._anywhere = "tcp/0.0.0.0" if family == 4 else "tcp/[::]"
        write_names(hosts, family)
        self.joining = (f"--run={RUN}", "--connect", self._endpoint("head", LEARNER_PORT), "--join-timeout=60")
        settings = (f"--total-steps={STEPS}", f"--replay.capacity={STEPS}", f"--replay.ratio={RATIO}")
        at = (f"--run={RUN}", f"--run-dir={folder}", "--listen", f"{self._anywhere}:{LEARNER_PORT}")
        flags = {
            "learner": (*at, "--preset=cartpole", "--learner.mirror=on", "--replay.journal", *settings),
            "replay": self._replay_flags(),
            "actor 1": self.joining,
            "actor 2": self.joining,
        }
        self.roles = Roles(folder, flags, lambda name: hosts[PLACES[name]].inside)

    def __str__(self) -> str:
        return f"IPv{self._family}, by {'name' if self._named else 'address'}"

    def lose_power(self) -> None:
        """End the replay service and cut its host off, without a word to the others."""
        self.hosts["rep"].unplug()
        self.roles.processes["replay"].end(0.0)

    def boot(self, port: int) -> None:
        """Connect the replay host again, with other addresses, and start its service."""
        host, self.port = self.hosts["rep"], port
        host.number += 10
        host.plug_in()
        write_names(self.hosts, self._family)
        self.roles.start_again("replay", (*self._replay_flags(), "--resume"))

    def _endpoint(self, name: str, port: int) -> str:
        address = self.hosts[name].address(self._family)
        return f"tcp/{name if self._named else f'[{address}]' if self._family == 6 else address}:{port}"

    def _replay_flags(self) -> tuple[str, ...]:
        at = self._endpoint("rep", self.port)
        listening = (
            ("--listen", f"{self._anywhere}:{self.port}", "--advertise", at) if self._named else ("--listen", at)
        )
        return (*self.joining, f"--run-dir={self._folder}", *listening)


@dataclass(frozen=True)
class Incident:
    """What happens to a run.

    begin, end: do it, and undo it. within: seconds after the end in which everybody must work again.
    others: whether the other hosts work meanwhile.
    """

    begin: Callable[[Trial], None]
    end: Callable[[Trial], None]
    within: float = 5.0
    others: bool = False


def cut(name: str, others: bool = False) -> Incident:
    """A host loses its link."""
    return Incident(lambda trial: trial.hosts[name].down(), lambda trial: trial.hosts[name].up(), others=others)


INCIDENTS = {
    "head cut": cut("head"),
    "act1 cut": cut("act1", others=True),
    "rep cut": cut("rep"),
    "rep rebooted, back on another address": Incident(Trial.lose_power, lambda trial: trial.boot(trial.port), 30.0),
    "rep rebooted, back on another port and address": Incident(
        Trial.lose_power, lambda trial: trial.boot(trial.port + 1), 30.0
    ),
}
SCENARIOS = (  # incident, family, by name
    ("head cut", 4, False),
    ("act1 cut", 4, True),
    ("act1 cut", 6, False),
    ("rep cut", 6, True),
    ("rep rebooted, back on another address", 4, True),
    ("rep rebooted, back on another port and address", 4, False),
    ("rep rebooted, back on another port and address", 6, False),
    ("rep rebooted, back on another port and address", 6, True),
)


def meet(trial: Trial, name: str, seconds: float) -> None:
    """Let a run meet an incident of some seconds, complete it, and print what was seen; raises a CoopError."""
    began, roles, incident = time.monotonic(), trial.roles, INCIDENTS[name]
    with running(roles), RunWatch(RUN, f"tcp/127.0.0.1:{LEARNER_PORT}") as watch:

        def rate() -> float:
            before = sum(watch.acked().values())
            time.sleep(LOAD)
            return (sum(watch.acked().values()) - before) / LOAD

        def begun() -> bool:
            roles.check(*roles.processes)
            return len(watch.acked()) == 2 and min(watch.acked().values()) > 0 and watch.updates() > 0

        wait_until("everybody at work", begun, 120)
        usual = rate()
        incident.begin(trial)
        time.sleep(seconds - LOAD)
        meanwhile = rate()
        held, updates = watch.acked(), watch.updates()
        if incident.others != (meanwhile > 0):
            raise RunError(f"{name}: {meanwhile:.0f} steps/s meanwhile")
        incident.end(trial)

        def at_work() -> bool:
            now = watch.acked()
            return watch.updates() > updates and all(now[actor] > held[actor] for actor in held)

        back = wait_until("everybody's return", at_work, incident.within)
        again = rate()
        roles.check(*roles.processes)
        hurry = command("coop-limits", *trial.joining, f"--ratio={CLOSING_RATIO}")
        subprocess.run([*trial.hosts["head"].inside, *hurry], stdout=subprocess.DEVNULL, check=True)
        summary = roles.ended()
    (gaps, twice), refused = audit(roles.folder), summary["duplicates_refused"]
    lost = gaps + summary["transitions_lost"]
    print(
        f"{trial}: {name} for {seconds:g} s; {usual:.0f} steps/s before, {meanwhile:.0f} meanwhile, {again:.0f} after; "
        f"all at work again {back:.1f} s after the return; {summary['exit']}, {summary['transitions_accepted']:,} "
        f"transitions, lost {lost}, duplicated {twice} ({refused} second deliveries refused); "
        f"{time.monotonic() - began:.0f} s",
        flush=True,
    )
    if lost or twice or not summary["exit"].startswith("complete"):
        raise RunError("the run did not complete with every transition once")


def meet_all(hosts: dict[str, Host], only: str, seconds: float) -> None:
    """Let a run meet each incident with `only` in its name; raises a CoopError."""
    for name, family, named in SCENARIOS:
        if only in name:
            with tempfile.TemporaryDirectory() as folder:
                trial = Trial(Path(folder) / "run", hosts, family, named)
                try:
                    meet(trial, name, seconds)
                except CoopError as error:
                    said = (f"{role}: {process.last_line()}" for role, process in trial.roles.processes.items())
                    raise RunError("\n  ".join((f"{trial}: {name}: {error}", *said))) from error


def main() -> None:
    """Make the hosts, and run this script inside the first one."""
    parser = argparse.ArgumentParser(description="Cut hosts of a run from the network, and reboot one, under load.")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each cut, more than 5")
    parser.add_argument("--only", default="", help=f"only incidents with this in their name: {'; '.join(INCIDENTS)}")
    options = parser.parse_args()
    if not options.seconds > 5:
        parser.error(f"--seconds {options.seconds:g}: must be more than 5")
    try:
        inside_the_first(
            list(dict.fromkeys(PLACES.values())), lambda hosts: meet_all(hosts, options.only, options.seconds)
        )
    except CoopError as error:
        sys.exit(f"netns: error: {error}")


if __name__ == "__main__":
    main()
