"""Starts, watches, interrupts and ends child processes on this machine: a run's roles or a sweep's runs."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from coop.common.errors import RunError
from coop.common.places import working_directory
from coop.common.process.lifecycle import SIGNALS, SUPERVISED, out_of_memory, status_after
from coop.common.process.limits import memory_kills, memory_limit
from coop.common.process.output import keep_standard_files

SIGNAL_STATUSES = tuple(map(status_after, SIGNALS))
INHERITED = "COOP_LOCKS"  # comma-separated descriptors of locks that a process inherits from its supervisor
LAST_WORDS = 400  # characters of a log's line
SAYS_WHY = ": error: "  # in the line in which a command says why it fails
_NUMBERS = re.compile(r"0x[0-9a-f]+|[0-9][0-9,.:]*")  # steps, times, ports: not the same at each start
# Signals by which a process ends itself.
FAULTS = tuple(-number for number in (signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV))


class ChildProcess:
    """A command as a child process in its own process group, with a log file; it ends when this process ends.

    Args:
        name: shown to users, for example "actor 2".
        inherit: file descriptors of locks that the child holds too. environment: variables that it gets as well.
        directory: in which it works; if None, the one in which this process was started.
    """

    def __init__(
        self,
        name: str,
        command: list[str],
        log: Path,
        inherit: tuple[int, ...] = (),
        environment: Mapping[str, str] = MappingProxyType({}),
        directory: Path | None = None,
    ) -> None:
        self.name = name
        self._command = command
        self._log = log
        self._inherit = inherit
        self._environment = environment
        self._directory = directory
        self._process: subprocess.Popen[bytes] | None = None
        self._begin = 0  # of what this start has written to the log, in bytes
        self._memory_kills = 0  # before this start

    def start(self) -> None:
        """Start or restart it. Raises RunError if the system refuses a process, OSError for its log."""
        keep_standard_files()
        self._memory_kills = memory_kills()
        try:
            self._start()
        except OSError as error:
            if line := out_of_memory(error):
                raise RunError(f"{self.name}: {line}") from error
            raise

    def _start(self) -> None:
        with self._log.open("ab") as log:
            self._begin = log.tell()
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self._directory or working_directory(),
                pass_fds=self._inherit,
                start_new_session=True,  # a Ctrl-C at the terminal reaches the supervisor alone
                env={
                    **os.environ,
                    **self._environment,
                    SUPERVISED: str(os.getpid()),
                    INHERITED: ",".join(map(str, self._inherit)),
                },
            )

    @property
    def pid(self) -> int:
        """Process id; 0 before the start."""
        return self._process.pid if self._process is not None else 0

    def exit_status(self) -> int | None:
        """The exit status; None while it runs."""
        return None if self._process is None else self._process.poll()

    def was_interrupted(self) -> bool:
        """True if SIGINT, SIGTERM or SIGHUP ended it, cleanly or during its start."""
        return self.exit_status() in (*SIGNAL_STATUSES, *(-number for number in SIGNALS))

    def was_killed_for_memory(self) -> bool:
        """True if the system has killed it because its memory was used up."""
        return self.exit_status() == -signal.SIGKILL and memory_kills() > self._memory_kills

    def own_words(self) -> str:
        """How it ended by itself, the same at each start if it ends like that again; empty if others ended it."""
        status = self.exit_status() or 0
        if self.was_interrupted() or (status < 0 and status not in FAULTS):
            return ""
        return f"{status} {_NUMBERS.sub('#', self._reason()) if status > 0 else ''}"

    def interrupt(self) -> None:
        """Ask it to stop cleanly."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def end(self, seconds: float) -> None:
        """Wait for its end; kill it after `seconds`."""
        if self._process is None:
            return
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def why(self) -> str:
        """Describe how it ended; if not by a signal, with the line of its log that says why."""
        status = self.exit_status() or 0
        if self.was_killed_for_memory():
            return f"{self.name} (pid {self.pid}) was killed because the memory is used up; {memory_limit()}"
        if status < 0:
            return f"{self.name} (pid {self.pid}) was killed by {signal.Signals(-status).name}"
        if status == 0:
            return f"{self.name} (pid {self.pid}) ended by itself before the run did (exit status 0)"
        line = self._reason()
        return f"{self.name} ended (exit status {status})" + (f": {line}" if line else "")

    def last_line(self) -> str:
        """The last line that it printed."""
        lines = self._lines()
        return lines[-1] if lines else ""

    def has_said(self, words: str) -> bool:
        """Whether a line that it has printed since this start holds `words`."""
        return any(words in line for line in self._lines())

    def _reason(self) -> str:
        """The line in which it says why it failed, or else its last line."""
        return reason_in(self._lines())

    def _lines(self) -> list[str]:
        """What it has printed since this start."""
        with self._log.open("rb") as log:
            log.seek(self._begin)
            return log.read().decode(errors="replace").strip().splitlines()


def command(name: str, *flags: str) -> list[str]:
    """The command line of a console command: the script beside the interpreter, or on PATH, or else its module.

    Scripts of packages that are installed with --target lie in none of these places.
    """
    path = Path(sysconfig.get_path("scripts")) / name
    found = str(path) if path.exists() else shutil.which(name)
    return [*([found] if found else [sys.executable, "-P", "-m", "coop.deploy.commands", name]), *flags]


def free_endpoint(like: str = "") -> str:
    """An endpoint with a free port and the protocol and address of `like` (TCP on loopback if that has no port)."""
    endpoint, port = reserve_endpoint(like)
    port.close()
    return endpoint


def reserve_endpoint(like: str = "") -> tuple[str, socket.socket]:
    """As `free_endpoint`, and the socket that keeps the port from all but who listens there, as long as it is open."""
    port = socket.socket()
    port.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as listeners have it
    port.bind(("127.0.0.1", 0))
    return f"{like.rpartition(':')[0] or 'tcp/127.0.0.1'}:{port.getsockname()[1]}", port


def reason_in(lines: Sequence[str]) -> str:
    """The line of a log in which a command says why it failed, or else the last one."""
    return next((line for line in reversed(lines) if SAYS_WHY in line), lines[-1] if lines else "")[:LAST_WORDS]
