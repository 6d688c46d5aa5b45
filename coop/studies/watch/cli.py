"""`coop-watch`: shows a run by its learner's messages, or a run or a sweep by its folder."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from tyro.conf import Positional

from coop.common.errors import JoinError, PeerLost, UsageError
from coop.common.messaging.transport import new_incarnation
from coop.common.numbers import strict_json
from coop.common.process.cli import given_flags, parse
from coop.common.process.console import say
from coop.common.process.flags import HttpAddress
from coop.common.process.lifecycle import Stop, run_main
from coop.common.process.output import out
from coop.common.process.untrusted import check_links, check_run
from coop.common.settings.options import check_waits
from coop.common.settings.tables import CONFIG
from coop.monitor.screen import RunScreen
from coop.monitor.watch import Display, Followed, RunStatus, live_page, report
from coop.studies.watch.run import RunFolder
from coop.studies.watch.screen import SweepPage, WatchedSweep, sweep_screen
from coop.studies.watch.sweep import SweepFolder

TICK = 0.1  # seconds
TICK_OF_FILES = 1.0  # seconds
_OF_MESSAGES = ("run", "connect", "join_timeout", "patience", "zenoh_config")


@dataclass(frozen=True)
class WatchOptions:
    """Flags of `coop-watch`."""

    dir: Annotated[Positional[Path | None], tyro.conf.arg(metavar="DIR")] = None
    """Folder of a run or a sweep on this machine, running or ended, which its files show."""
    run: str = "coop"
    """Name of the run."""
    connect: str = "tcp/127.0.0.1:7447"
    """Endpoint of the learner, for example tcp/head:7447."""
    join_timeout: float = 30.0
    """Seconds to search for the learner before giving up."""
    patience: float = 60.0
    """Seconds to wait for a lost learner before giving up."""
    zenoh_config: Path | None = None
    """A Zenoh configuration file (TLS, access control); the endpoint given as a flag still applies."""
    once: bool = False
    """Print the present status and end."""
    web: HttpAddress = ""
    """Show the screen as a web page too: PORT, on loopback, or HOST:PORT; of a folder, until Ctrl-C."""
    json: bool = False
    """With --once: print one JSON object instead of the screen; docs/watching.md lists its fields."""

    def __post_init__(self) -> None:
        """Raise UsageError for a name that no run has, and for what is no time to wait."""
        check_run(self.run)
        check_waits(self.join_timeout, self.patience)


def main() -> None:
    """Entry point."""
    run_main("coop-watch", _run)


def _run() -> None:
    options = parse(WatchOptions, "coop-watch", "Show the live status of a run until it ends, or a folder of runs.")
    if options.json and not options.once:
        raise UsageError("--json: needs --once")
    if options.web and options.once:
        raise UsageError("--web: shows a live run; leave out --once")
    ctrl_c = Stop()
    ctrl_c.on_signals()
    if options.dir is not None:
        _watch_folder(options.dir, options, ctrl_c)
        return
    status = RunStatus(options.run, options.connect, new_incarnation(), options.zenoh_config)
    with closing(status):
        if options.once:
            while status.learner is None:
                if ctrl_c.wait(TICK):
                    ctrl_c.raise_for_status()
                status.refresh()
                _check(status, options)
            _print_once(status, options)
        else:
            _follow(status, options, ctrl_c)


def _watch_folder(folder: Path, options: WatchOptions, ctrl_c: Stop) -> None:
    """Show what the files of a run or a sweep tell; raises UsageError for a folder that is neither."""
    if given := sorted(given_flags(sys.argv[1:]) & set(_OF_MESSAGES)):
        raise UsageError(f"--{given[0].replace('_', '-')}: for a run that is found by its learner, not by its folder")
    if not folder.is_dir():
        raise UsageError(f"{folder}: {'no folder' if folder.exists() else 'no such folder'}")
    config, starting = folder / CONFIG, folder / "logs" / CONFIG
    if starting.exists() and not config.exists():
        if options.once:
            raise UsageError(f"{folder}: the run there is only starting")
        say(f"{folder}: the run there is only starting")
        while not config.exists():
            if ctrl_c.wait(TICK_OF_FILES):
                ctrl_c.raise_for_status()
    if config.exists():
        check_links(folder)
        run = RunFolder(folder)
        run.refresh()
        _print_once(run, options) if options.once else _follow(run, options, ctrl_c)
        return
    sweep = SweepFolder(folder)
    sweep.refresh()
    if options.once:
        print(strict_json(sweep.report()), file=out()) if options.json else Console().print(sweep_screen(sweep))
        return
    with _sweep_page(sweep, options.web) as page, WatchedSweep(sweep, page) as display:
        if page is not None:
            display.say(f"this screen is also at {page.url}")
        while (page is not None or not sweep.over) and not ctrl_c.wait(TICK_OF_FILES):
            display.update()
    Console().print(sweep_screen(sweep))


@contextmanager
def _sweep_page(sweep: SweepFolder, address: str) -> Iterator[SweepPage | None]:
    if not address:
        yield None
        return
    with closing(SweepPage(sweep, address)) as page:
        yield page


def _follow(run: Followed, options: WatchOptions, ctrl_c: Stop) -> None:
    """Show the status until the run ends; on the page of a folder, until Ctrl-C."""
    by_files = isinstance(run, RunFolder)
    with live_page(run.run, options.web) as page, Display(run, page) as display:
        stays = by_files and page is not None
        while (stays or not run.over()) and not ctrl_c.wait(TICK_OF_FILES if by_files else TICK):
            display.update()
            if isinstance(run, RunStatus):
                _check(run, options)
        if run.learner is not None:
            display.say(run.line())
        if run.over():
            display.say(f"the run has ended: {run.over()}")


def _print_once(run: Followed, options: WatchOptions) -> None:
    """Print a status."""
    if options.json and run.learner is not None:
        say(strict_json(report(run.run, run.learner)))
    else:
        lines = [line for _, line in run.events()]
        Console().print(RunScreen(run.run, run.learner, lines, whole=True))


def _check(status: RunStatus, options: WatchOptions) -> None:
    """Raise JoinError or PeerLost if the learner has been silent for too long."""
    silent = status.silent_for()
    if status.learner is None and silent > options.join_timeout:
        raise JoinError(status.why_nothing(options.join_timeout))
    if status.learner is not None and silent > options.patience:
        raise PeerLost(f"the learner of run {options.run!r} has been silent for {options.patience:g} s")
