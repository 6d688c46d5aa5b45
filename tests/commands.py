"""Console commands and programs, each in a process of its own, forked where torch has been imported.

A cold start takes seconds.
"""

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

from forked import become, forked_process


class Command:
    """A command that has been started; its output goes to files. As a context it is killed at its end.

    name: of a console command, or the file of a program. environment: all variables; those of this process if None.
    out: a pipe that its standard output goes to, or a terminal that it begins a session on. nohup: ignore SIGHUP.
    """

    def __init__(
        self,
        name: str | Path,
        *flags: str | Path,
        cwd: Path | None = None,
        environment: Mapping[str, str] | None = None,
        out: Path | None = None,
        nohup: bool = False,
    ) -> None:
        self.arguments = list(map(str, (name, *flags)))
        self._folder = tempfile.TemporaryDirectory()
        files = [Path(self._folder.name, stream) for stream in ("out", "err")]
        self._files = files if out is None else [out, out if out.is_char_device() else files[1]]
        variables = dict(os.environ if environment is None else environment)
        self._process = forked_process(_run, self.arguments, str(cwd or Path.cwd()), variables, self._files, nohup)
        assert self._process.pid is not None
        self.pid = self._process.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *reason: object) -> None:
        self.send_signal(signal.SIGKILL)
        self._process.join()
        self._folder.cleanup()

    def output(self) -> tuple[str, str]:
        """What it has written so far to standard output and to standard error."""
        out, err = (file.read_text(encoding="utf-8") if file.is_file() else "" for file in self._files)
        return out, err

    @property
    def returncode(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        """Send it a signal, if it still runs."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def wait(self, timeout: float) -> int:
        """Wait for its end; return its exit status. Raises TimeoutExpired."""
        self._process.join(timeout)
        if (status := self.returncode) is None:
            raise subprocess.TimeoutExpired(self.arguments, timeout, *self.output())
        return status

    def communicate(self, timeout: float) -> tuple[str, str]:
        """Wait for its end; return all that it has written. Raises TimeoutExpired."""
        self.wait(timeout)
        return self.output()

    def end(self, timeout: float) -> subprocess.CompletedProcess[str]:
        """Wait for its end; raises TimeoutExpired, having killed it."""
        with self:
            return subprocess.CompletedProcess(self.arguments, self.wait(timeout), *self.output())


def run_command(
    name: str | Path,
    *flags: str | Path,
    cwd: Path | None = None,
    environment: Mapping[str, str] | None = None,
    timeout: float = 120,
    check: bool = False,
) -> subprocess.CompletedProcess[str]:
    """What `subprocess.run` does with the command's script, its output captured as text.

    name, environment: see `Command`. check: raise CalledProcessError at another status than 0.
    """
    done = Command(name, *flags, cwd=cwd, environment=environment).end(timeout)
    if check and done.returncode:
        raise subprocess.CalledProcessError(done.returncode, done.args, done.stdout, done.stderr)
    return done


def run_for_a_line(name: str, *flags: str | Path, cwd: Path, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    """What `run_command` returns, of a command whose reader goes once it has read a line."""
    with tempfile.TemporaryDirectory() as folder:
        os.mkfifo(pipe := Path(folder, "pipe"))
        with Command(name, *flags, cwd=cwd, out=pipe) as process:
            with pipe.open(encoding="utf-8") as reader:
                line = reader.readline()
            return subprocess.CompletedProcess(process.arguments, process.wait(timeout), line, process.output()[1])


def wait_for(what: str, reached: object, seconds: float = 60.0) -> None:
    """Look until `reached()` is true; fail after `seconds`."""
    deadline = time.monotonic() + seconds
    while not reached():  # type: ignore[operator]
        assert time.monotonic() < deadline, f"{what}: not within {seconds} s"
        time.sleep(0.1)


def lines(path: Path) -> int:
    """The number of a file's lines; 0 if it is not there."""
    return len(path.read_text().splitlines()) if path.exists() else 0


def _run(
    arguments: Sequence[str], cwd: str, environment: Mapping[str, str], files: Sequence[Path], nohup: bool
) -> None:
    os.setsid()
    for number, file in enumerate(files, 1):
        terminal = file.is_char_device()  # opened for reading too, it is the session's
        descriptor = os.open(file, os.O_RDWR if terminal else os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for each in (0, number) if terminal else (number,):
            os.dup2(descriptor, each)
        os.close(descriptor)
    if nohup:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    become(arguments, cwd, environment)
