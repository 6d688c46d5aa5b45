"""Runs of one process where the system has no more than macOS: no /proc, and none of what Python has on Linux alone."""

import os
import subprocess
import sys
from pathlib import Path

import yaml

WORKFLOW = Path(__file__).parents[1] / ".github/workflows/test.yml"
WITHOUT_LINUX = """
import builtins, errno, fcntl, io, os, resource, select, signal, socket, time

LINUX_ONLY = {
    fcntl: ["F_ADD_SEALS", "F_GETPIPE_SZ", "F_GET_SEALS", "F_OFD_SETLK", "F_OFD_SETLKW", "F_SETPIPE_SZ"],
    os: ["copy_file_range", "eventfd", "getrandom", "memfd_create", "pidfd_open", "posix_fadvise", "posix_fallocate",
         "sched_getaffinity", "sched_setaffinity", "sched_setscheduler", "splice", "O_DIRECT", "O_PATH", "O_TMPFILE"],
    resource: ["prlimit", "RLIMIT_OFILE", "RUSAGE_THREAD"],
    select: ["epoll"],
    signal: ["SIGPWR", "SIGRTMAX", "SIGRTMIN", "sigtimedwait", "sigwaitinfo"],
    socket: ["SO_BINDTODEVICE", "SO_DOMAIN", "SO_PASSCRED", "SO_PEERCRED", "SO_PROTOCOL", "TCP_USER_TIMEOUT"],
    time: ["CLOCK_BOOTTIME", "CLOCK_TAI"],
}
for module, names in LINUX_ONLY.items():
    for name in names:
        vars(module).pop(name, None)


def without_proc(function):
    def called(path, *arguments, **named):
        if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith("/proc"):
            raise FileNotFoundError(errno.ENOENT, "there is no /proc here", os.fspath(path))
        return function(path, *arguments, **named)
    return called


builtins.open = io.open = without_proc(io.open)
for name in ("listdir", "lstat", "open", "readlink", "scandir", "stat"):
    setattr(os, name, without_proc(getattr(os, name)))
"""
AS_POOR_AS_MEANT = "if python -c 'import os; os.sched_getaffinity(0)' 2> python.txt; then exit 9; fi\n"


def test_runs_of_one_process_use_nothing_that_linux_alone_has(tmp_path: Path) -> None:
    """The commands are those of the job for macOS."""
    (tmp_path / "sitecustomize.py").write_text(WITHOUT_LINUX)
    steps = yaml.safe_load(WORKFLOW.read_text(encoding="utf-8"))["jobs"]["macos"]["steps"]
    commands = next(step["run"] for step in steps if "coop-lockstep" in step.get("run", ""))
    found = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    variables = {"PYTHONPATH": os.pathsep.join(found), "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-e", "-c", AS_POOR_AS_MEANT + commands],
        cwd=tmp_path,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert not done.returncode, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert list((tmp_path / "runs/study").glob("*/summary.json"))
