"""Runs the code of a page of the documentation as a reader would: in order, in one folder.

Hosts other than this one become this one, with free ports. Learners, replay services and actors run until the page
ends, or until another one takes a replay service's place.
"""

import re
import shlex
import signal
import subprocess
import time
import tomllib
import warnings
from collections.abc import Mapping
from pathlib import Path

import yaml
from commands import Command, run_command

from coop.common.process.processes import free_endpoint
from coop.common.settings.tables import resolve
from coop.studies.sweep.grid import parse_grid
from website.pages import LANGUAGES, ROOT, Block, blocks

TRAINS = ("coop-local", "coop-lockstep", "coop-learner")
READY = {"coop-learner": "listens on", "coop-replay": "joined run", "coop-actor": "joined run"}
ADDED = "the tests add: "
HOST = re.compile(r"(?<=[/ ])(?:head|0\.0\.0\.0|10\.0\.0\.5)(?::(\d+))?(?![\w.])")
PATIENCE = 300.0  # seconds; on a busy machine a run of 400 steps takes minutes


class Reader:
    """Follows a page in a folder."""

    def __init__(self, folder: Path) -> None:
        """Work in a folder, which has what pages take from a checkout."""
        for name in ("deploy", "results"):
            (folder / name).symlink_to(ROOT / name)
        self.folder = folder
        self.ran = 0
        self._shared: dict[str, object] = {}
        self._ports: dict[str, str] = {}
        self._services: list[Command] = []

    def follow(self, page: str) -> None:
        """Run every block of a page but those that say that they are not run, and end what they have started."""
        try:
            for block in blocks(page):
                assert block.language in LANGUAGES, f"{page}, line {block.line}: a code block needs a language"
                if block.code and not block.why_not_run:
                    self._run(block)
                    self.ran += 1
            for service in self._services:
                self._wait_for(service)
        finally:
            for service in reversed(self._services):
                self._end(service)

    def _run(self, block: Block) -> None:
        if file := re.match(r"# ([\w-]+\.(?:py|toml))\n", block.text):
            (self.folder / file[1]).write_text(block.text, encoding="utf-8")
        if block.language == "toml":
            _check(tomllib.loads(block.text), block)
        elif block.language == "yaml":
            assert yaml.safe_load(block.text)
        elif block.language == "bash":
            added = shlex.split(block.note.removeprefix(ADDED)) if block.note.startswith(ADDED) else []
            for line in block.text.replace("\\\n", "").splitlines():
                self._type(HOST.sub(self._here, line), added)
        elif not file:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # an example may leave a file open
                exec(compile(block.text, block.page, "exec"), self._shared)

    def _type(self, line: str, added: list[str]) -> None:
        """Run one line of a shell."""
        words = shlex.split(line, comments=True)
        if not words:
            return
        name, *flags = words
        flags += added if name in TRAINS else []
        if name in READY:
            self._replace(name)
            self._services.append(Command(name, *flags, cwd=self.folder))
        elif name.startswith("coop-"):
            done = run_command(name, *flags, cwd=self.folder, timeout=PATIENCE)
            assert done.returncode == 0, f"{shlex.join(done.args)}: {done.stderr}"
        else:
            subprocess.run(["bash", "-c", line], cwd=self.folder, timeout=PATIENCE, check=True, capture_output=True)

    def _here(self, host: re.Match[str]) -> str:
        """This machine in place of another, with a port of its own for each of the page's."""
        if host[1] is None:
            return "127.0.0.1"
        return self._ports.setdefault(host[1], free_endpoint().removeprefix("tcp/"))

    def _replace(self, name: str) -> None:
        """End the replay service before another one starts: a run has one."""
        for service in [each for each in self._services if each.arguments[0] == name == "coop-replay"]:
            self._wait_for(service)
            self._services.remove(service)
            self._end(service)

    @staticmethod
    def _wait_for(service: Command) -> None:
        """Wait until a role is at work."""
        name = service.arguments[0]
        deadline = time.monotonic() + PATIENCE
        while not any(READY[name] in text for text in service.output()):
            assert service.returncode is None, f"{name} ended: {service.output()}"
            assert time.monotonic() < deadline, f"{name}: {service.output()}"
            time.sleep(0.05)

    @staticmethod
    def _end(service: Command) -> None:
        service.send_signal(signal.SIGINT)
        service.end(PATIENCE)


def _check(tables: Mapping[str, object], block: Block) -> None:
    """Resolve a grid or a run's config; a table of a project file has nothing to resolve."""
    if isinstance(tables.get("methods"), list):
        assert parse_grid(block.text, block.page).cells
    elif "project" not in tables:
        resolve(tables)
