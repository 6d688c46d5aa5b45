"""Console commands, each in a process of its own, forked where torch has been imported: a cold start takes seconds."""

import os
import signal
import socket
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path

from forked import SERVER, become, forked_children, serve

SUPERVISORS = ("coop-local", "coop-sweep")


class Command:
    """A console command that has been started; its output goes to files in a folder of its own.

    environment: all variables; those of this process if None.
    """

    def __init__(
        self, name: str, *flags: str | Path, cwd: Path | None = None, environment: Mapping[str, str] | None = None
    ) -> None:
        self.arguments = [name, *map(str, flags)]
        self._folder = tempfile.TemporaryDirectory()
        self._files = [Path(self._folder.name, stream) for stream in ("out", "err")]
        variables = dict(os.environ if environment is None else environment)
        self._process = SERVER.Process(
            target=_run, args=(self.arguments, str(cwd or Path.cwd()), variables, list(map(str, self._files)))
        )
        self._process.start()

    def output(self) -> tuple[str, str]:
        """What it has written so far to standard output and to standard error."""
        out, err = (file.read_text(encoding="utf-8") if file.exists() else "" for file in self._files)
        return out, err

    def status(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._process.exitcode

    def interrupt(self) -> None:
        """Send it SIGINT."""
        if self._process.pid is not None and self.status() is None:
            os.kill(self._process.pid, signal.SIGINT)

    def end(self, timeout: float) -> subprocess.CompletedProcess[str]:
        """Wait for its end; raises TimeoutExpired, having killed it."""
        self._process.join(timeout)
        status = self.status()
        if status is None:
            self._process.kill()
            self._process.join()
        out, err = self.output()
        self._folder.cleanup()
        if status is None:
            raise subprocess.TimeoutExpired(self.arguments, timeout, out, err)
        return subprocess.CompletedProcess(self.arguments, status, out, err)


def run_command(
    name: str,
    *flags: str | Path,
    cwd: Path | None = None,
    environment: Mapping[str, str] | None = None,
    timeout: float = 120,
    check: bool = False,
) -> subprocess.CompletedProcess[str]:
    """What `subprocess.run` does with the command's script, its output captured as text.

    environment: see `Command`. check: raise CalledProcessError at another status than 0.
    """
    done = Command(name, *flags, cwd=cwd, environment=environment).end(timeout)
    if check and done.returncode:
        raise subprocess.CalledProcessError(done.returncode, done.args, done.stdout, done.stderr)
    return done


def _run(arguments: Sequence[str], cwd: str, environment: Mapping[str, str], files: Sequence[str]) -> None:
    for number, file in enumerate(files, 1):
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT)
        os.dup2(descriptor, number)
        os.close(descriptor)
    with forked_children(_fork) if arguments[0] in SUPERVISORS else nullcontext():
        become(arguments, cwd, environment)


def _fork(asking: socket.socket, requests: socket.socket) -> None:
    if os.fork() == 0:
        asking.close()
        serve(requests)
        os._exit(0)
