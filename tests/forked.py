"""Starts the children of a command, such as the roles of a topology, as forks of a process that has imported torch.

A cold start takes seconds. Such a child differs from one of `subprocess.Popen` in its `/proc/PID/cmdline` only: it is a
child of the process that asks for it, in a session of its own, with its own variables, directory and descriptors.
"""

import ctypes
import json
import multiprocessing
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import chdir, contextmanager, nullcontext
from importlib.metadata import entry_points
from multiprocessing.context import ForkServerProcess
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

from coop.common.process import processes
from coop.common.process.lifecycle import SUPERVISED

TESTS = str(Path(__file__).parent)
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["warm"])
ADOPT, NAME = 36, 15  # PR_SET_CHILD_SUBREAPER, PR_SET_NAME
LARGEST = 1 << 20  # bytes of a request
POLL = 0.001  # seconds
SUPERVISORS = ("coop-local", "coop-sweep")


def forked_process(target: Callable[..., object], *args: object) -> ForkServerProcess:
    """A started process, forked from the server, which finds its `warm` in the folder that it is started in."""
    with chdir(TESTS):
        ensure_running()
    process = SERVER.Process(target=target, args=args)
    process.start()
    return process


@contextmanager
def forked_children(start: Callable[[socket.socket, socket.socket], object]) -> Iterator[None]:
    """Within it, `ChildProcess` starts its commands as such forks.

    start: begins a process that closes the first socket and calls `serve` with the second one.
    """
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    start(here, there)
    there.close()
    lock, prctl = threading.Lock(), ctypes.CDLL(None).prctl

    class Forked(subprocess.Popen[bytes]):
        def __init__(
            self, args: list[str], *, stdout: IO[bytes], cwd: Path, pass_fds: Sequence[int], env: Any, **rest: Any
        ) -> None:
            if not Path(args[0]).name.startswith("coop-"):  # no console command
                super().__init__(args, stdout=stdout, cwd=cwd, pass_fds=pass_fds, env=env, **rest)
                return
            assert rest == {"stdin": subprocess.DEVNULL, "stderr": subprocess.STDOUT, "start_new_session": True}
            self.args = args
            self.stdin = self.stdout = self.stderr = self.returncode = None  # type: ignore[assignment]
            self._waitpid_lock, self._child_created = threading.Lock(), True
            request = json.dumps([args, str(cwd), dict(env), list(pass_fds)]).encode()
            with lock:
                prctl(ADOPT, 1, 0, 0, 0)
                socket.send_fds(here, [request], [stdout.fileno(), *pass_fds])
                self.pid = int(here.recv(64))
                while _parent(self.pid) != os.getpid():
                    time.sleep(POLL)
                prctl(ADOPT, 0, 0, 0, 0)

    original = processes.subprocess
    processes.subprocess = SimpleNamespace(**{**vars(subprocess), "Popen": Forked})  # type: ignore[assignment]
    try:
        yield
    finally:
        processes.subprocess = original
        here.close()


def _parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def serve(requests: socket.socket) -> None:
    """Fork a process for each request until nobody can ask any more.

    It is a child of a child that ends at once, so that the process that asks adopts it.
    """
    while True:
        request, descriptors, _, _ = socket.recv_fds(requests, LARGEST, 16)
        if not request:
            return
        if (between := os.fork()) == 0:
            arguments = json.loads(request), descriptors
            process = multiprocessing.get_context("fork").Process(target=_begin, args=arguments)
            process.start()
            requests.send(str(process.pid).encode())
            os._exit(0)
        os.waitpid(between, 0)
        for each in descriptors:
            os.close(each)


def _begin(request: Any, descriptors: Sequence[int]) -> None:
    arguments, cwd, environment, passed = request
    while os.getppid() != int(environment[SUPERVISED]):
        time.sleep(POLL)
    os.setsid()
    log, *given = (os.dup(each) for each in descriptors)
    for have, number in ((os.open(os.devnull, os.O_RDONLY), 0), (log, 1), (log, 2), *zip(given, passed, strict=True)):
        os.dup2(have, number)
    become([Path(arguments[0]).name, *arguments[1:]], cwd, environment)


def _fork(asking: socket.socket, requests: socket.socket) -> None:
    if os.fork() == 0:
        asking.close()
        serve(requests)
        os._exit(0)


def become(arguments: Sequence[str], cwd: str, environment: Mapping[str, str]) -> None:
    """Run a console command, or a program in a file, in this process; what it starts in turn is forked as well."""
    name = arguments[0]
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    own = environment.get("PYTHONPATH", "")
    others = [place for place in sys.path if not place.startswith(TESTS)]
    sys.path[:] = [*(own.split(os.pathsep) if own else ()), *others]
    sys.argv = list(arguments)
    ctypes.CDLL(None).prctl(NAME, Path(name).name.encode(), 0, 0, 0)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    with forked_children(_fork) if name in SUPERVISORS or name.endswith(".py") else nullcontext():
        if name.endswith(".py"):
            sys.path.insert(0, str(Path(name).parent))
            runpy.run_path(name, run_name="__main__")
        else:
            (script,) = entry_points(group="console_scripts", name=name)
            script.load()()
