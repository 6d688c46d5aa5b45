"""`coop-replay`: the replay service of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from common.errors import PeerLost, RunError, UsageError
from common.messaging.joining import Membership, join
from common.messaging.messages.join import Join, Joined
from common.messaging.presence import LEASE
from common.messaging.transport import Node, locators, new_incarnation, open_session
from common.process import cli
from common.process.lifecycle import Stop, run_main
from common.process.memory import keep_freed_memory
from common.settings.options import RoleOptions
from replay.core import ReplayCore
from replay.persistence.epochs import ReplayEpochs
from replay.persistence.journal import Journal, journal_files
from replay.persistence.recovery import recover
from replay.service import ReplayService


@dataclass(frozen=True)
class ReplayOptions(RoleOptions):
    """Flags of `coop-replay`."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    """Endpoints to listen on; port 0 takes a free one."""
    run_dir: Path = Path("runs/replay")
    """Where this service's part of the epochs is written, under checkpoints/."""
    resume: bool = False
    """Go on from what is in --run-dir, if anything is."""


def main() -> None:
    """Entry point."""
    run_main("coop-replay", _run)


def _run() -> None:
    options = cli.parse(
        ReplayOptions, "coop-replay", "Serve the replay table of a run; the rest comes from its learner."
    )
    keep_freed_memory()
    stop = Stop()
    stop.on_signals()
    stop.on_thread_failures()
    incarnation = new_incarnation()
    session = open_session(options.listen, options.connect, options.zenoh_config, options.shared_memory)
    with Node(session, options.run, "replay", incarnation) as node:
        node.follow_stop(stop)
        request = Join("replay", incarnation, locators(session))
        joined = join(node, stop, request, options.connect, options.join_timeout)
        if joined is not None:
            service = _service(node, joined, options)

            def learned(_: Joined, asked: float) -> None:
                service.confirm(asked + LEASE)

            with Membership(node, stop, request, joined, options.patience, learned):
                service.start()
                service.run(stop)
    if stop.failed:
        raise PeerLost(stop.reason)


def _service(node: Node, joined: Joined, options: ReplayOptions) -> ReplayService:
    """A service that goes on where --run-dir says, or that begins.

    Raises:
        UsageError: there is a run in --run-dir and --resume was not given, or it is another run.
        RunError: the journal can't be read or written.
    """
    core = ReplayCore(joined.config, joined.spec)
    folder = options.run_dir / "journal"
    epochs = ReplayEpochs(options.run_dir, joined.run_id)
    first, found = 1, "begins with an empty table"
    if options.resume:
        first, found = epochs.restore(core, joined.epoch)
    elif epochs.any() or journal_files(folder):
        raise UsageError(f"--run-dir {options.run_dir}: holds a run already; give another, or --resume")
    if joined.config.replay.journal:
        number, carried_out = recover(core, folder, first, joined.run_id)
        found = f"{found}; {carried_out}"
        try:
            journal = Journal(folder, joined.run_id, number, keep=joined.config.replay.journal_keep)
        except OSError as error:
            raise RunError(f"journal in {folder}: {error.strerror or error}") from error
        core.recorder = journal
        epochs = ReplayEpochs(options.run_dir, joined.run_id, journal)
    print(found, flush=True)
    return ReplayService(node, core, epochs, confirmed=0.0)
