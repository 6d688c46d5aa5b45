"""Limits of a job: memory and cores of control groups, Slurm and ulimit, and processes that are killed for memory."""

import contextlib
import os
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from coop.common.process.limits import MIB, cores, memory_kills, memory_limit
from coop.deploy.supervisor import HEALTHY, MEMORY_RESTARTS, RestartPolicy

SCRIPTS = Path(sysconfig.get_path("scripts"))
MACHINE = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
V1 = Path("/sys/fs/cgroup/memory")


def tree(root: Path, groups: str, mounts: str, files: dict[str, str]) -> Path:
    """A machine's /proc and control groups below `root`."""
    for name, text in {"proc/self/cgroup": groups, "proc/self/mountinfo": mounts, **files}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


MOUNT_2 = "31 23 0:28 / /sys/fs/cgroup rw shared:4 - cgroup2 cgroup2 rw,nsdelegate\n"
MOUNTS_1 = (
    "32 31 0:29 /docker/f00 /sys/fs/cgroup/cpu,cpuacct ro - cgroup cgroup rw,cpu,cpuacct\n"
    "35 31 0:32 /docker/f00 /sys/fs/cgroup/memory ro master:9 - cgroup cgroup rw,memory\n"
)
SLURM = "system.slice/slurmstepd.scope/job_7"


@pytest.mark.parametrize(
    ("groups", "mounts", "files", "size", "count"),
    [
        ("0::/\n", MOUNT_2, {"memory.max": "max\n", "cpu.max": "max 100000\n"}, None, None),
        ("0::/\n", MOUNT_2, {"memory.max": f"{300 * MIB}\n", "cpu.max": "150000 100000\n"}, 300, 2),
        # The least of a group and of those above it.
        (f"0::/{SLURM}/step_0\n", MOUNT_2,
         {f"{SLURM}/memory.max": f"{200 * MIB}\n", f"{SLURM}/step_0/memory.max": "max\n",
          f"{SLURM}/step_0/cpu.max": "50000 100000\n"}, 200, 1),
        # A container that sees its own group as the root, under the host's name of it.
        ("5:memory:/docker/f00\n4:cpu,cpuacct:/docker/f00\n", MOUNTS_1,
         {"memory/memory.limit_in_bytes": f"{100 * MIB}\n", "cpu,cpuacct/cpu.cfs_quota_us": "100000\n",
          "cpu,cpuacct/cpu.cfs_period_us": "100000\n"}, 100, 1),
        ("5:memory:/docker/f00\n4:cpu,cpuacct:/docker/f00\n", MOUNTS_1,
         {"memory/memory.limit_in_bytes": "9223372036854771712\n", "cpu,cpuacct/cpu.cfs_quota_us": "-1\n",
          "cpu,cpuacct/cpu.cfs_period_us": "100000\n"}, None, None),
        ("0::/gone\n", MOUNT_2, {"memory.max": f"{400 * MIB}\n"}, 400, None),
        ("", "", {}, None, None),
    ],
)  # fmt: skip
def test_limits_of_control_groups(
    groups: str, mounts: str, files: dict[str, str], size: int | None, count: int | None, tmp_path: Path
) -> None:
    root = tree(tmp_path, groups, mounts, {f"sys/fs/cgroup/{name}": text for name, text in files.items()})
    assert memory_limit(root, {}).size == (MACHINE if size is None else size * MIB)
    have = len(os.sched_getaffinity(0))
    assert cores(root, {}) == (have if count is None else min(have, count))


@pytest.mark.parametrize(
    ("variables", "size", "source"),
    [
        ({"SLURM_MEM_PER_NODE": "100"}, 100, "SLURM_MEM_PER_NODE"),
        ({"SLURM_MEM_PER_CPU": "50", "SLURM_CPUS_ON_NODE": "4"}, 200, "SLURM_MEM_PER_CPU"),
        ({"SLURM_MEM_PER_CPU": "50", "SLURM_CPUS_PER_TASK": "2"}, 100, "SLURM_MEM_PER_CPU"),
        ({"SLURM_MEM_PER_NODE": "0"}, None, "this machine"),
        ({"SLURM_MEM_PER_NODE": "many"}, None, "this machine"),
    ],
)
def test_limits_of_slurm(variables: dict[str, str], size: int | None, source: str, tmp_path: Path) -> None:
    limit = memory_limit(tmp_path, variables)
    assert limit.size == (MACHINE if size is None else size * MIB)
    assert source in str(limit)
    assert cores(tmp_path, {"SLURM_CPUS_PER_TASK": "1", "SLURM_CPUS_ON_NODE": "64"}) == 1


@pytest.mark.parametrize(
    ("line", "source"),
    [
        ("SLURM_MEM_PER_NODE=100 coop-lockstep {}", "Slurm's job has (SLURM_MEM_PER_NODE) 0.1 GiB"),
        ("SLURM_MEM_PER_NODE=100 coop-local {}", "Slurm's job has (SLURM_MEM_PER_NODE) 0.1 GiB"),
        ("ulimit -v 12000000; coop-lockstep {}", "ulimit -v allows 11.4 GiB"),
    ],
)
def test_a_table_larger_than_the_job_s_memory(line: str, source: str, tmp_path: Path) -> None:
    large = "--replay.capacity 500000000 --total-steps 500000000"
    path = f"{SCRIPTS}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", line.format(large)], cwd=tmp_path, env={**os.environ, "PATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith(source)


MAPPED = "libtorch_cpu.so: failed to map segment from shared object"  # what the loader says of too little memory


@pytest.mark.parametrize(
    ("work", "words"),
    [
        ("np.zeros(2**33, np.uint8)", " ("),
        (f"(_ for _ in ()).throw(ImportError({MAPPED!r}))", f" (ImportError: {MAPPED})"),
        ("(threading.stack_size(2**33), threading.Thread(target=print).start())", " and processes (ulimit -u)"),
    ],
)
def test_memory_that_the_system_refuses_is_one_line(work: str, words: str) -> None:
    code = f"""
import resource, threading
import numpy as np
from coop.common.process.lifecycle import run_main
resource.setrlimit(resource.RLIMIT_AS, (2**32, 2**32))
run_main("coop-x", lambda: {work})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith(f"coop-x: error: not enough memory{words}")
    assert done.stderr.endswith("; ulimit -v allows 4.0 GiB\n")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("work", "words"),
    [
        ('ChildProcess("replay", [sys.executable], Path(os.devnull)).start', "replay: "),
        ("lambda: zenoh.open(zenoh.Config())", ""),
    ],
)
def test_processes_that_the_system_refuses_are_one_line(work: str, words: str) -> None:
    code = f"""
import os, resource, sys
from pathlib import Path
import zenoh
from coop.common.process.lifecycle import run_main
from coop.common.process.processes import ChildProcess
if os.getuid() == 0:
    os.setuid(65534)  # root has as many as it likes
resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
run_main("coop-x", {work})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"coop-x: error: {words}not enough memory and processes (ulimit -u) (")


@contextlib.contextmanager
def control_group(size: int) -> Iterator[Path]:
    """A real control group with so many bytes of memory, without swap."""
    group = V1 / f"coop-test-{os.getpid()}"
    try:
        group.mkdir()
    except OSError as error:
        pytest.skip(f"no control group of memory can be made here: {error}")
    try:
        (group / "memory.limit_in_bytes").write_text(str(size))
        with contextlib.suppress(OSError):
            (group / "memory.memsw.limit_in_bytes").write_text(str(size))
        yield group
    finally:
        deadline = time.monotonic() + 10
        while (group / "cgroup.procs").read_text() and time.monotonic() < deadline:
            time.sleep(0.05)
        group.rmdir()


SUPERVISES = """
import sys, time
from pathlib import Path
from coop.common.process.limits import memory_limit
from coop.common.process.processes import ChildProcess
print(memory_limit())
for code in ("data = b'x' * 2**28", "import os; os.kill(os.getpid(), 9)"):
    child = ChildProcess("replay", [sys.executable, "-c", code], Path(sys.argv[1], "log"))
    child.start()
    child.end(60)
    print(child.was_killed_for_memory(), child.why())
"""


def test_a_process_that_is_killed_for_memory_is_named(tmp_path: Path) -> None:
    with control_group(64 * MIB) as group:
        (tmp_path / "supervises.py").write_text(SUPERVISES)
        joined = f"echo $$ > {group}/cgroup.procs && exec {sys.executable} {tmp_path}/supervises.py {tmp_path}"
        done = subprocess.run(["bash", "-c", joined], capture_output=True, text=True, check=True, timeout=100)
    limit, killed, other = done.stdout.splitlines()
    assert limit == "the control group's memory.limit_in_bytes allows 0.1 GiB"
    assert killed.startswith("True replay (pid ")
    assert killed.endswith(f"was killed because the memory is used up; {limit}")
    assert other.startswith("False replay (pid ")
    assert other.endswith("was killed by SIGKILL")


def test_it_is_not_started_again_for_ever() -> None:
    policy, now = RestartPolicy(), 0.0
    for _ in range(MEMORY_RESTARTS):
        now += 10 * HEALTHY  # a table takes its time to outgrow the memory
        assert not policy.ended(now, for_memory=True)
    assert policy.ended(now + 10 * HEALTHY, for_memory=True) == f"it has been started again {MEMORY_RESTARTS} times"


def test_kills_are_counted_where_the_system_counts_them(tmp_path: Path) -> None:
    files = {"sys/fs/cgroup/a/memory.events": "oom 3\noom_kill 2\n", "proc/vmstat": "nr 1\noom_kill 9\n"}
    assert memory_kills(tree(tmp_path / "group", "0::/a\n", MOUNT_2, files)) == 2
    assert memory_kills(tree(tmp_path / "root", "0::/\n", MOUNT_2, files)) == 9
