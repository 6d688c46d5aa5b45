"""Cuts the power under a replay service: `python benchmarks/acked.py --cuts 100`; needs root, for loop mounts.

A `coop-replay` with a journal writes to an ext4 file system of its own and acknowledges segments. The image is copied
at random moments, as `benchmarks/power.py` does; what had not reached the disk is not in the copy. Each copy's journal
is recovered. The table says how many transitions had been acknowledged before a copy began and are not in it.
"""

from __future__ import annotations

import random
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path

from journal import Service, settings
from made_up import ATARI
from power import mounted, options, snapshot

from coop.replay.core import ReplayCore
from coop.replay.persistence.recovery import recover

MIB = 1024
FEW = 5  # cuts of one service, which fills its disk meanwhile


def main() -> None:
    asked, rng = options(__doc__)
    print("| journal | cuts | acknowledged | of them lost: median (most) | cuts that lost any |")
    print("| --- | ---: | ---: | ---: | ---: |")
    found = {}
    for journal in ("sync", "async"):
        counts = []
        while len(counts) < asked:
            with tempfile.TemporaryDirectory() as folder:
                counts += cut(journal, Path(folder), min(FEW, asked - len(counts)), rng)
        lost = found[journal] = [max(0, acked - there) for acked, there in counts]
        told = f"{statistics.median(lost):,.0f} ({max(lost):,}) | {sum(map(bool, lost))} |"
        print(f"| {journal} | {len(counts)} | {sum(acked for acked, _ in counts):,} | {told}", flush=True)
    sys.exit(1 if any(found["sync"]) else 0)


def cut(journal: str, folder: Path, cuts: int, rng: random.Random) -> list[tuple[int, int]]:
    """Of each cut, the transitions acknowledged before it and those in its journal."""
    disk, at, copies = folder / "disk.img", folder / "m", []
    with disk.open("wb") as file:
        file.truncate(MIB << 20)
    subprocess.run(["mkfs.ext4", "-q", "-F", str(disk)], check=True)
    with mounted(disk, at), ExitStack() as stack:
        service = Service(stack, journal, at / "run")
        done = threading.Event()
        writer = threading.Thread(target=lambda: [service.insert(0.2, save=False) for _ in iter(done.is_set, True)])
        writer.start()
        while not service.acked:
            time.sleep(0.1)
        for number in range(cuts):
            time.sleep(rng.uniform(0.1, 0.8))
            image = folder / f"cut{number}.img"
            copies.append((image, snapshot(disk, image, service.pid, lambda: service.acked)))
        done.set()
        writer.join()
    found = []
    for image, acked in copies:
        with mounted(image, folder / "c"):
            core = ReplayCore(settings("recovered", journal), ATARI)
            recover(core, folder / "c" / "run" / "journal", 1, 0)
            found.append((acked, core.table.inserted))
        image.unlink()
    return found


if __name__ == "__main__":
    main()
