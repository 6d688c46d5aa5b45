"""Starts, watches, interrupts and ends child processes on this machine: a run's roles or a sweep's runs."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from common.process.lifecycle import SIGNALS, SUPERVISED, status_after
from common.process.locks import INHERITED

SIGNAL_STATUSES = tuple(map(status_after, SIGNALS))
LAST_WORDS = 400  # characters of a log's last line


class ChildProcess:
    """A command as a child process in its own process group, with a log file; it ends when this process ends.

    Args:
        name: shown to users, for example "actor 2".
        inherit: file descriptors of locks that the child holds too. environment: variables that it gets as well.
        directory: in which it works; this process's if None.
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

    def start(self) -> None:
        """Start or restart it."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self._directory,
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
        """True if SIGINT or SIGTERM ended it, cleanly or during its start."""
        return self.exit_status() in (*SIGNAL_STATUSES, *(-number for number in SIGNALS))

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
        """Describe how it ended; if not by a signal, with the last line of its log."""
        status = self.exit_status() or 0
        if status < 0:
            return f"{self.name} (pid {self.pid}) was killed by {signal.Signals(-status).name}"
        line = self.last_line()[-LAST_WORDS:]
        return f"{self.name} ended (exit status {status})" + (f": {line}" if line else "")

    def last_line(self) -> str:
        """The last line that it printed."""
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


def command(name: str, *flags: str) -> list[str]:
    """The command line of a console command: the script beside the interpreter, or on PATH, or else its module.

    Scripts of packages that are installed with --target lie in none of these places.
    """
    path = Path(sysconfig.get_path("scripts")) / name
    found = str(path) if path.exists() else shutil.which(name)
    return [*([found] if found else [sys.executable, "-m", "deploy.commands", name]), *flags]


def free_endpoint(like: str = "tcp/127.0.0.1:0") -> str:
    """An endpoint with a free port and the protocol and address of `like` (TCP on loopback if that has no port)."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{like.rpartition(':')[0] or 'tcp/127.0.0.1'}:{probe.getsockname()[1]}"
