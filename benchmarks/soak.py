"""Watches a run at full rate for a given time: `python benchmarks/soak.py --seconds 900`.

Memory, threads and file descriptors of every role must not grow after the first minute: the script compares the last
quarter of the time with the first. Otherwise the exit status is 1. A role that does not answer for longer than the
lease gets a new link, which may take the others some MiB: the last line counts that. Further flags go to the learner;
the table must be full within the first minute (`--preset catch --replay.capacity 2000 --replay.learning-starts 1000`).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from roles import Roles, running

from coop.common.errors import CoopError, RunError
from coop.common.process.processes import free_endpoint

ACTORS = 2
WARM_UP = 60.0  # seconds
EVERY = 1.0  # seconds
ALLOWED = {"MiB": 0.02, "threads": 0.0, "descriptors": 0.0}  # growth, as a share

Sample = dict[str, float]


def measure(pid: int) -> Sample:
    """The present resources of a process."""
    proc = Path("/proc") / str(pid)
    status = dict(line.split(":", 1) for line in (proc / "status").read_text().splitlines())
    return {
        "MiB": int(status["VmRSS"].split()[0]) / 1024,
        "threads": int(status["Threads"]),
        "descriptors": len(list((proc / "fd").iterdir())),
    }


def soak(seconds: float, folder: Path, flags: Sequence[str]) -> None:
    """Print the table; raise a CoopError if a resource grows or a process ends."""
    roles = Roles.of_run(
        folder,
        "soak",
        (free_endpoint(), free_endpoint()),
        ("--total-steps=1000000000", "--checkpoint-every=2000", *flags),
        ACTORS,
    )
    samples: dict[str, list[Sample]] = defaultdict(list)
    with running(roles):
        began = time.monotonic()
        while time.monotonic() - began < WARM_UP + seconds:
            time.sleep(EVERY)
            roles.check(*roles.processes)
            if time.monotonic() - began >= WARM_UP:
                for name, process in roles.processes.items():
                    samples[name].append(measure(process.pid))
        summary = roles.finish()
    grown = []
    print(f"{'':10}" + "".join(f"{what:>28}" for what in ALLOWED))
    for name, taken in samples.items():
        quarter = -(-len(taken) // 4)
        cells = ""
        for what, share in ALLOWED.items():
            values = [sample[what] for sample in taken]
            first, last = median(values[:quarter]), median(values[-quarter:])
            cells += f"{first:10.1f} -> {last:6.1f} (<= {max(values):5.1f})"
            if last > first * (1 + share):
                grown.append(f"{what} of {name}")
        print(f"{name:10}{cells}")
    back = (folder / "logs" / "learner.log").read_text(encoding="utf-8").count(" is back")
    done = f"{summary['env_steps']:,} steps, {summary['updates']:,} updates, {summary['wall_seconds']:.0f} s"
    print(f"{done}; roles that had stopped answering came back {back} times")
    if grown:
        raise RunError(f"not flat: {', '.join(grown)}")


def main() -> None:
    """Parse flags and run."""
    parser = argparse.ArgumentParser(description="Watch memory, threads and descriptors of a run at full rate.")
    parser.add_argument("--seconds", type=float, default=900.0, help="after the first minute")
    options, flags = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as folder:
        try:
            soak(options.seconds, Path(folder) / "run", flags)
        except CoopError as error:
            sys.exit(f"soak: error: {error}")


if __name__ == "__main__":
    main()
