"""Cuts the power of runs: `python benchmarks/power.py --cuts 100`; needs root, for loop mounts.

A run, a run over processes with a journal, and a sweep write to an ext4 file system of their own. Its image is copied
at random moments: what had not reached the disk is not in the copy. Each copy is mounted, which replays the file
system's journal, and the run is resumed on it. The table says of each kind how many could be resumed, whether a cell of
a sweep counts as finished although its files are not, and how many steps were lost.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import random
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from coop.common.process.processes import command

EVERY = 1000  # updates between checkpoints
GRID = 'preset = "cartpole"\nmethods = ["dqn"]\nseeds = {seeds}\n[fixed]\ntotal_steps = {steps}\n'
LONG = ("--preset=cartpole", "--total-steps=2000000", f"--checkpoint-every={EVERY}", "--network.hidden=8")
MIB = 96
RESUMED = 40.0  # seconds to go on, on a busy machine

T = TypeVar("T")


def main() -> None:
    asked, rng = options(__doc__)
    failed = 0
    shares = {"lockstep": asked * 2 // 5, "local": asked * 3 // 10}
    shares["sweep"] = asked - sum(shares.values())
    print("| writes | cuts | resumed | falsely finished | steps lost: median (most) | checkpoint every |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for kind, cuts in shares.items():
        with tempfile.TemporaryDirectory() as folder:
            problems, losses, false = cut(kind, Path(folder), cuts, rng)
        failed += len(problems) + false
        lost = f"{statistics.median(losses):,.0f} ({max(losses):,})" if losses else ""
        every = f"{EVERY:,} updates" if kind != "sweep" else "a cell's end"
        print(f"| {kind} | {cuts} | {cuts - len(problems)} | {false} | {lost} | {every} |", flush=True)
        for problem in problems:
            print(problem, flush=True)
    sys.exit(1 if failed else 0)


def options(text: str | None) -> tuple[int, random.Random]:
    """The number of cuts that the command line asks for, and the generator of their moments; exits without root."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cuts", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if os.geteuid():
        sys.exit(f"{parser.prog}: loop mounts need root")
    return given.cuts, random.Random(given.seed)


def cut(kind: str, folder: Path, cuts: int, rng: random.Random) -> tuple[list[str], list[int], int]:
    """Cut the power of a kind of run, again and again; return problems, steps lost, and cells falsely finished."""
    disk, at = folder / "disk.img", folder / "m"
    problems: list[str] = []
    losses: list[int] = []
    false = done = 0
    while done < cuts:
        disk.unlink(missing_ok=True)  # whoever has not closed the one before writes to that one
        with disk.open("wb") as file:
            file.truncate(MIB << 20)
        subprocess.run(["mkfs.ext4", "-q", "-F", str(disk)], check=True)
        few = min(8, cuts - done)
        images = []
        with mounted(disk, at), started(kind, at, folder, done) as process:
            wait_for(lambda: begun(kind, at), process)
            for number in range(few):
                time.sleep(rng.uniform(0.2, 2.5))
                image = folder / f"cut{number}.img"
                images.append((image, snapshot(disk, image, process.pid, lambda: steps(kind, at))))
        for image, before in images:
            with mounted(image, folder / "c"):
                problem, after, wrong = resume(kind, folder / "c", folder)
            image.unlink()
            problems += [problem] if problem else []
            false += wrong
            if not problem and kind != "sweep":
                losses.append(max(0, before - after))
        done += few
    return problems, losses, false


def snapshot(disk: Path, image: Path, pid: int, look: Callable[[], T]) -> T:
    """Copy a disk as it is at one moment; return what was to be seen then.

    The process that writes to it and its descendants are stopped meanwhile: of a disk that changes while it is copied,
    the parts would be of different moments, which no power cut leaves.
    """
    with frozen(pid):
        seen = look()
        while True:
            subprocess.run(["cp", "--sparse=always", str(disk), str(image)], check=True)
            if subprocess.run(["cmp", "--silent", str(disk), str(image)], check=False).returncode == 0:
                return seen  # the kernel wrote nothing either


@contextlib.contextmanager
def frozen(pid: int) -> Iterator[None]:
    """Stop a process and its descendants; let them go on at the end."""
    family = stop(pid)
    try:
        yield
    finally:
        send(signal.SIGCONT, family)


def stop(pid: int) -> list[int]:
    """Stop a process, and then its descendants; returns all of them."""
    stopped, family = [], [pid]
    while family:
        with contextlib.suppress(OSError):
            os.kill(member := family.pop(), signal.SIGSTOP)
            stopped.append(member)
            for started in Path(f"/proc/{member}/task").glob("*/children"):
                family += map(int, started.read_text().split())
    return stopped


def send(number: signal.Signals, family: list[int]) -> None:
    """Send a signal to those that are still there."""
    for member in family:
        with contextlib.suppress(ProcessLookupError):
            os.kill(member, number)


def kill(process: subprocess.Popen[Any]) -> None:
    """Kill a process with its descendants, which may have sessions of their own."""
    if process.poll() is None:
        send(signal.SIGKILL, stop(process.pid))
    process.wait()


@contextlib.contextmanager
def mounted(image: Path, at: Path) -> Iterator[None]:
    """Mount an image."""
    at.mkdir(exist_ok=True)
    subprocess.run(["mount", "-o", "loop", str(image), str(at)], check=True)
    try:
        yield
    finally:
        unmount(at)


def unmount(at: Path) -> None:
    """Unmount, once the last process has closed its files there."""
    for _ in range(100):
        if subprocess.run(["umount", str(at)], capture_output=True, check=False).returncode == 0:
            return
        time.sleep(0.1)
    subprocess.run(["umount", "--lazy", str(at)], check=True)


@contextlib.contextmanager
def started(kind: str, at: Path, folder: Path, number: int) -> Iterator[subprocess.Popen[bytes]]:
    """Run something of a kind, and kill it, with its processes, at the end."""
    if kind == "lockstep":
        arguments = command("coop-lockstep", *LONG, f"--run-dir={at / 'run'}")
    elif kind == "local":
        arguments = command("coop-local", *LONG, "--actors=1", "--replay.journal", f"--run-dir={at / 'run'}")
    else:
        grid = folder / "grid.toml"
        grid.write_text(GRID.format(seeds=list(range(number, number + 60)), steps=600))
        arguments = command("coop-sweep", str(grid), "--dir", str(at / "sweep"), "--jobs", "2")
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(arguments, stdout=log, stderr=log, start_new_session=True)
    try:
        yield process
    finally:
        kill(process)


def begun(kind: str, at: Path) -> bool:
    """Whether the first checkpoint, or the first cell, is finished."""
    return any(at.glob("run/checkpoints/*/DONE" if kind != "sweep" else "sweep/*/summary.json"))


def wait_for(reached: object, process: subprocess.Popen[bytes]) -> None:
    """Wait until it is true."""
    assert callable(reached)
    while not reached():
        if process.poll() is not None:
            sys.exit("power: the run ended before its first checkpoint")
        time.sleep(0.05)


def steps(kind: str, at: Path) -> int:
    """Environment steps at the last episode of a run."""
    path = at / "run" / "episodes.csv"
    if kind == "sweep" or not path.exists():
        return 0
    lines = path.read_bytes()[-4096:].decode().rpartition("\n")[0].splitlines()
    return int(lines[-1].split(",")[1]) if len(lines) > 1 else 0


def resume(kind: str, at: Path, folder: Path) -> tuple[str, int, int]:
    """Resume what is on a disk: (problem, steps at the checkpoint it goes on from, cells that are falsely finished)."""
    if kind == "sweep":
        return resume_sweep(at, folder)
    name = "coop-lockstep" if kind == "lockstep" else "coop-local"
    log = folder / "resumed"
    with log.open("wb") as file:
        process = subprocess.Popen(
            command(name, "--resume", f"--run-dir={at / 'run'}"), stdout=file, stderr=file, start_new_session=True
        )
    path, deadline = at / "run" / "metrics.jsonl", time.monotonic() + RESUMED
    size = -1
    try:
        while process.poll() is None and time.monotonic() < deadline:
            text = log.read_text(errors="replace")
            if "resuming from checkpoint" in text or "starts in" in text:
                size = path.stat().st_size if size < 0 and path.exists() else size
                if size >= 0 and path.exists() and path.stat().st_size > size:
                    break  # it trains
            time.sleep(0.1)
        problem = "" if process.poll() is None and size >= 0 else f"{kind}: {log.read_text(errors='replace')[-300:]}"
    finally:
        kill(process)
    found = re.search(r"resuming from checkpoint (\d+)", log.read_text(errors="replace"))
    return problem, step_of(at / "run", int(found[1]) if found else 0), 0


def step_of(run: Path, updates: int) -> int:
    """Environment steps at the last episode before an update."""
    with (run / "episodes.csv").open(encoding="utf-8") as file:
        ended = [int(row["env_step"]) for row in csv.DictReader(file) if int(row["update"] or 0) <= updates]
    return ended[-1] if ended else 0


def resume_sweep(at: Path, folder: Path) -> tuple[str, int, int]:
    """Go on with a sweep until it says how many cells it takes for finished; check these."""
    process = subprocess.Popen(
        command("coop-sweep", str(folder / "grid.toml"), "--dir", str(at / "sweep"), "--jobs", "1"),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    lines = [process.stdout.readline() for _ in range(2)]  # the first one: the settings
    kill(process)
    process.stdout.close()
    found = re.search(r"(\d+) of them finished before", lines[1])
    if found is None:
        return f"sweep: {' '.join(lines)}", 0, 0
    whole = 0
    for summary in at.glob("sweep/*/summary.json"):
        with contextlib.suppress(ValueError, KeyError, OSError):
            summed_up = json.loads(summary.read_text())
            rows = summary.with_name("episodes.csv").read_text().splitlines()
            whole += summed_up["exit"] == "complete" and len(rows) == summed_up["episodes"] + 1
    return "", 0, max(0, int(found[1]) - whole)


if __name__ == "__main__":
    main()
