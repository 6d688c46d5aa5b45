"""`coop-replay`: the replay service of a run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec

from coop.common.errors import RunError
from coop.common.messaging.conversation import Conversation, drive
from coop.common.messaging.endpoints import check_endpoints
from coop.common.messaging.joining import Membership, joining, leaving
from coop.common.messaging.links import locators
from coop.common.messaging.messages.control import MOST_CHECKPOINTS, Join, JoinReply
from coop.common.messaging.session import open_session
from coop.common.messaging.timing import LEASE
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.places import absolute
from coop.common.process import cli
from coop.common.process.console import Console
from coop.common.process.lifecycle import Stop, run_main
from coop.common.process.memory import keep_freed_memory
from coop.common.settings.options import HealthOptions, RoleOptions
from coop.monitor.health import answering
from coop.replay.core import ReplayCore
from coop.replay.persistence.checkpoints import ReplayCheckpoints
from coop.replay.persistence.folder import ReplayFolder
from coop.replay.persistence.journal import Journal
from coop.replay.persistence.recovery import recover
from coop.replay.preload import preload
from coop.replay.service import ReplayService


@dataclass(frozen=True)
class ReplayOptions(RoleOptions, HealthOptions):
    """Flags of `coop-replay`."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    """Endpoints to listen on; port 0 chooses a free port."""
    advertise: tuple[str, ...] = ()
    """Endpoints to tell actors, for example tls/replay:7448; those that it listens on, by address, if not given."""
    run_dir: Path | None = None
    """Folder of this service's parts of checkpoints; runs/RUN-replay-ID if not given, with the run's name and id."""
    resume: bool = False
    """Continue from the state in --run-dir; start afresh if it holds nothing of this run yet."""


def main() -> None:
    """Entry point."""
    run_main("coop-replay", _run)


def _run() -> None:
    options = cli.parse(ReplayOptions, "coop-replay", "Serve the replay table of a run; its learner sends the config.")
    keep_freed_memory()
    stop = Stop()
    stop.on_signals()
    stop.on_thread_failures()
    console = Console()
    session = open_session(options.listen, options.connect, options.zenoh_config, options.shared_memory)
    check_endpoints(options.advertise)
    with Node(session, options.run, "replay", new_incarnation()) as node, answering(options.health, console):
        drive(serving_run(node, stop, options, locators(session), console), stop)
    stop.raise_for_status()


def serving_run(
    node: Node, stop: Stop, options: ReplayOptions, listens: list[str], console: Console
) -> Conversation[None]:
    """Join a run, serve it until the stop, and then until the learner has saved a checkpoint.

    listens: the endpoints of the node.
    """
    node.follow_stop(stop)
    incarnation = node.incarnation
    ask = partial(joining, node, connect=options.connect, timeout=options.join_timeout, event=console.event)
    known = yield from ask(Join("replay", incarnation, []))
    if known is None:
        return
    folder = ReplayFolder(options.run_dir or _named(options.run, known.run_id), known.run_id)
    console.event(folder.check(resume=options.resume))
    with folder.lock():
        parts = ReplayCheckpoints(folder.path, known.run_id)
        held = parts.intact()
        if problems := parts.passed_over():
            console.event(f"passes over {problems}")
        request = Join("replay", incarnation, [*(options.advertise or listens)], checkpoints=held[-MOST_CHECKPOINTS:])
        reply = yield from ask(request)
        if reply is not None:
            yield from _serving(node, stop, options, folder, request, reply, console)


def _named(run: str, run_id: int) -> Path:
    return absolute(Path("runs") / f"{run}-replay-{run_id:x}")


def _serving(
    node: Node,
    stop: Stop,
    options: ReplayOptions,
    folder: ReplayFolder,
    request: Join,
    reply: JoinReply,
    console: Console,
) -> Conversation[None]:
    service = _service(node, reply, folder, console, shared_memory=options.shared_memory)

    def learned(_: JoinReply, asked: float) -> None:
        service.confirm(asked + LEASE)

    console.event(f"joined run {options.run!r} on {reply.learner}; listens on {', '.join(request.endpoints)}")
    rejoining = msgspec.structs.replace(request, serving=True)
    with Membership(node, stop, rejoining, reply, options.patience, learned, console.event):
        service.start()
        yield from service.serving(stop, console)
    if not stop.failed:
        yield from leaving(node, request)
    service.close()
    console.event(f"{stop.reason}; {service.progress()}")


def _service(
    node: Node, reply: JoinReply, folder: ReplayFolder, console: Console, *, shared_memory: bool
) -> ReplayService:
    """Build a service from the folder's state: the learner's checkpoint, and the journal after it if there is one.

    Raises:
        RunError: the journal cannot be read or written.
        UsageError: the folder's table has other settings, or the data set of `replay.preload` can't be used.
    """
    core = ReplayCore(reply.config, reply.spec, shared_memory=shared_memory)
    checkpoints = ReplayCheckpoints(folder.path, folder.run_id, start=node.start)
    try:
        aside = checkpoints.go_back(reply.checkpoint, anew=reply.anew)
    except OSError as error:
        raise RunError(f"{folder.path}: {error.strerror or error}") from error
    first, found = checkpoints.restore(core, reply.checkpoint)
    for line in filter(None, (aside, found)):
        console.event(line)
    for line in () if core.table.preloaded else preload(core.table, reply.config):
        console.event(line)
    settings, synced = reply.config.replay, None
    if settings.journal != "off":
        sync = settings.journal == "sync"
        number, notices = recover(core, folder.journal, first, folder.run_id, sync=sync)
        for line in notices:
            console.event(line)
        keep, accepted = settings.journal_keep, core.table.inserted
        try:
            journal = Journal(folder.journal, folder.run_id, number, keep=keep, sync=sync, accepted=accepted)
        except OSError as error:
            raise RunError(f"journal in {folder.journal}: {error.strerror or error}") from error
        core.recorder, synced = journal, journal if sync else None
        checkpoints = ReplayCheckpoints(folder.path, folder.run_id, journal, node.start)
    return ReplayService(node, core, checkpoints, confirmed=0.0, synced=synced)
