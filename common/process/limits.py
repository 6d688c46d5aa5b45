"""What this process may use: memory and processors of its job, where that is less than the machine has, and threads.

Sources are the machine, the process's own limits (ulimit), its control groups (version 1 and 2, with all above it) and
Slurm's variables. A source that is absent or unreadable limits nothing.
"""

from __future__ import annotations

import math
import os
import resource
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from coop.common.errors import UsageError

ROOT = Path("/")
UNLIMITED = 2**60  # bytes; version 1 writes "no limit" as the largest number of pages
MIB = 2**20


@dataclass(frozen=True, order=True)
class MemoryLimit:
    """The memory that a process may use, in bytes, and who says so."""

    size: int
    source: str

    def __str__(self) -> str:
        return f"{self.source} {self.size / 2**30:.1f} GiB"


def memory_limit(root: Path = ROOT, environment: Mapping[str, str] | None = None) -> MemoryLimit:
    """The least of all limits of memory.

    Args:
        root: in which /proc and the control groups' mounts are looked up. environment: this process's if None.
    """
    variables = os.environ if environment is None else environment
    found = [MemoryLimit(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), "this machine has")]
    for name, flag in ((resource.RLIMIT_AS, "-v"), (resource.RLIMIT_DATA, "-d")):
        soft, _ = resource.getrlimit(name)
        if soft != resource.RLIM_INFINITY:
            found.append(MemoryLimit(soft, f"ulimit {flag} allows"))
    for group in _groups("memory", root):
        for file in ("memory.max", "memory.limit_in_bytes"):
            if (size := _number(group / file)) is not None and size < UNLIMITED:
                found.append(MemoryLimit(size, f"the control group's {file} allows"))
    found += _of_slurm(variables)
    return min(found)


def check_processes(flag: str, number: int, least: int) -> None:
    """Raise UsageError for several processes of at least `least` bytes each that do not fit into the job's memory."""
    limit = memory_limit()
    if number > 1 and number * least > limit.size:
        raise UsageError(f"{flag} {number:,}: need {number * least / 2**30:,.1f} GiB and more; {limit}")


def _of_slurm(variables: Mapping[str, str]) -> Iterator[MemoryLimit]:
    """Slurm's limits, which it gives in MiB; 0 is all that the node has."""
    node = _positive(variables.get("SLURM_MEM_PER_NODE"))
    if node:
        yield MemoryLimit(node * MIB, "Slurm's job has (SLURM_MEM_PER_NODE)")
    each = _positive(variables.get("SLURM_MEM_PER_CPU"))
    names = ("SLURM_CPUS_ON_NODE", "SLURM_CPUS_PER_TASK")
    cpus = next((count for name in names if (count := _positive(variables.get(name)))), _affinity())
    if each:
        yield MemoryLimit(each * cpus * MIB, "Slurm's job has (SLURM_MEM_PER_CPU)")


def cores(root: Path = ROOT, environment: Mapping[str, str] | None = None) -> int:
    """The number of processors that this process may keep busy; at least 1."""
    variables = os.environ if environment is None else environment
    found = [_affinity()]
    for group in _groups("cpu", root):
        first = _words(group / "cpu.cfs_quota_us") + _words(group / "cpu.cfs_period_us")
        numbers = [_positive(word) for word in _words(group / "cpu.max") or first]
        match numbers:
            case [int(quota), int(period)] if quota and period:
                found.append(math.ceil(quota / period))
    for name in ("SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE"):
        if count := _positive(variables.get(name)):
            found.append(count)
            break
    return max(1, min(found))


def _affinity() -> int:
    """The number of processors that this process may run on; of the machine where the system does not say, as macOS."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def limit_threads() -> None:
    """Let libraries that start a thread per core of the machine start one per core of the job; before their import."""
    count = cores()
    if count < (os.cpu_count() or 1):
        os.environ.setdefault("OMP_NUM_THREADS", str(count))


def memory_kills(root: Path = ROOT) -> int:
    """How many processes of this one's control group, or of the machine if that does not say, memory's lack has killed.

    It grows when the system kills a process because the memory of its group, or all memory, is used up.
    """
    for group in _groups("memory", root):
        for file in ("memory.events", "memory.oom_control"):
            if (count := _entry(group / file, "oom_kill")) is not None:
                return count
    return _entry(root / "proc/vmstat", "oom_kill") or 0


def _groups(controller: str, root: Path) -> Iterator[Path]:
    """The folders of this process's control groups, from its own up to the root, of both versions.

    A container sees its group as the root of a mount, while /proc may name it by its place on the host: what of that
    name is not there is left out.
    """
    for mount, name in _hierarchies(controller, root):
        place = mount / name.strip("/")
        for group in (place, *place.parents):
            if group.is_dir():
                yield group
            if group == mount:
                break


def _hierarchies(controller: str, root: Path) -> Iterator[tuple[Path, str]]:
    """(mount, this process's group in it) of each hierarchy that may limit what a controller counts."""
    mounts = [line.split() for line in _lines(root / "proc/self/mountinfo")]
    for line in _lines(root / "proc/self/cgroup"):
        _, names, group = line.split(":", 2)
        if names and controller not in names.split(","):
            continue
        for words in mounts:
            kind, options = words[words.index("-") + 1], words[-1].split(",")
            if kind == ("cgroup" if names else "cgroup2") and (not names or controller in options):
                # The fourth word is the group that is the mount's root.
                yield root / words[4].lstrip("/"), group.removeprefix(words[3])


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _words(path: Path) -> list[str]:
    return " ".join(_lines(path)).split()


def _entry(path: Path, name: str) -> int | None:
    """The number that follows a name in a file of such lines."""
    return next((_positive(words[1]) for line in _lines(path) if (words := line.split())[:1] == [name]), None)


def _number(path: Path) -> int | None:
    words = _words(path)
    return _positive(words[0]) if words else None


def _positive(text: str | None) -> int | None:
    """A number; None for what is none, such as "max" and "-1"."""
    return int(text) if text is not None and text.isdecimal() else None


def use_threads(count: int) -> None:
    """Limit numpy's BLAS and, if it has been imported, PyTorch to `count` threads; by default both use every core."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(count)
    threadpool_limits(count, user_api="blas")
