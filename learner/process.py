"""The process of a run's learner: begins the training or continues it from a checkpoint, and ends it properly."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, nullcontext

import torch

from coop.common.errors import RunError, UsageError
from coop.common.messaging.conversation import Conversation, drive
from coop.common.messaging.links import locators
from coop.common.messaging.mirror import FrameMirror
from coop.common.messaging.sample_client import SampleClient
from coop.common.messaging.session import SHORT_QUEUE, open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.console import Console, say
from coop.common.process.lifecycle import Stop
from coop.common.process.limits import use_threads
from coop.common.settings.capacity import MIRROR_SHARE, frame_bytes, mirror_slots, mirrors, table_slots
from coop.common.settings.config import RunConfig
from coop.common.settings.resuming import settings_digest
from coop.common.types import EnvSpec
from coop.learner.agent import Agent
from coop.learner.checkpoints import Checkpoints
from coop.learner.cli import LearnerOptions
from coop.learner.device_mirror import DeviceMirror
from coop.learner.initial_networks import load_initial_networks
from coop.learner.join_service import JoinService
from coop.learner.roster import Roster
from coop.learner.service import LearnerService
from coop.learner.shared_checkpoints import SharedCheckpoints
from coop.learner.trainer import Trainer
from coop.monitor.health import answering
from coop.records.learner_checkpoints import check_spec, fitting, load_learner
from coop.records.locks import RunLock
from coop.records.resumption import Survey
from coop.records.run_directory import RunDirectory, claim_run_directory
from coop.records.summaries import Summary


def learn(options: LearnerOptions, config: RunConfig, spec: EnvSpec) -> None:
    """Train a run, whose config has been checked, in the run directory that the options name."""
    use_threads(config.learner.threads)
    stop = Stop()
    stop.on_signals()
    stop.on_thread_failures()
    path = options.directory()
    with RunLock(path, "coop-learner", ("learner",)) as lock:
        console = Console()
        found, notices = options.start.prepare(
            path, replay=False, settings=settings_digest(config), load=load_learner, every=True
        )
        _check_origin(found)
        for line in (*notices, options.settings):
            console.event(line)
        lock.sign()
        _train(options, config, spec, found, stop, console)


def _train(
    options: LearnerOptions, config: RunConfig, spec: EnvSpec, found: Survey, stop: Stop, console: Console
) -> None:
    """Train a run from its beginning, or from a checkpoint, to its end."""
    trainer = Trainer(Agent(config, spec), time.monotonic())
    if found.newest is None:
        load_initial_networks(trainer.agent)
    session = open_session(options.listen, (), options.zenoh_config, options.shared_memory, send_queue=SHORT_QUEUE)
    with Node(session, config.run, "learner", new_incarnation()) as node, answering(options.health, console):
        summary = drive(training_run(node, stop, trainer, found, options, locators(session), console), stop)
    if summary is not None:
        say(str(summary))
    if trainer.diverged:
        raise RunError(trainer.diverged)
    if summary is None or stop.failed or summary.exit == stop.reason:  # otherwise complete before the signal
        stop.raise_for_status()


def training_run(
    node: Node,
    stop: Stop,
    trainer: Trainer,
    found: Survey,
    options: LearnerOptions,
    listens: list[str],
    console: Console,
) -> Conversation[Summary | None]:
    """Train a run from what was found in its directory to its end; None if a stop comes before the first turn.

    trainer: new, with the initial networks. listens: the endpoints of the node.
    """
    config, spec, agent, path = trainer.config, trainer.agent.spec, trainer.agent, found.run_dir
    held = [each.number for each in reversed(found.whole)]
    shared = SharedCheckpoints(held, str(path), restart=options.restart)
    run_id = claim_run_directory(path, config) if found.newest is None else found.newest.manifest.run
    node.belong(run_id)
    roster = Roster(path, node.now(), run_id)
    layout = agent.networks[0].layout_digest()
    join_service = JoinService(node, config, spec, layout, run_id, shared, roster, console.event)
    console.event(f"run {config.run!r} listens on {', '.join(listens)}; files in {path}")
    if held:
        console.event("waiting for the replay service's list of checkpoints")
    number = yield from shared.decided()
    if number is None:
        return None
    state = found.of(number).state if number else None
    if state is not None:
        with fitting(found.of(number).path):
            check_spec(found.of(number), spec)
            trainer.load_state(state, node.now())
        found = found.cut_back(number, "the replay service has no whole part of it")
        skipped = "; ".join(found.fallbacks(number))
        console.event(f"resuming from checkpoint {number}{skipped and f'; passes over {skipped}'}")
    elif held:
        load_initial_networks(agent)
        console.event("starting over: learner and replay service share no checkpoint")
    settings, episodes_received = config.learner, 0 if state is None else state["episodes_received"]
    for each in found.whole:
        each.state.clear()  # only its memory
    samples = SampleClient(
        node,
        stop,
        node.incarnation,
        spec,
        settings.batch_size,
        settings.prefetch,
        agent.updates,
        episodes_received,
        shared_memory=options.shared_memory,
        mirror=_mirror(config, spec, agent.device, console),
    )
    steps = trainer.drawn.inserted
    with RunDirectory(path, config, found, number or None, steps, log=options.log) as directory:
        if directory.aside:
            console.event(directory.aside)
        checkpoints = Checkpoints(node, directory, samples, shared, console.event)
        service = LearnerService(node, stop, trainer, directory, samples, checkpoints, join_service, console)
        with _exported(options.prometheus, service):
            return (yield from service.training())


def _mirror(config: RunConfig, spec: EnvSpec, device: torch.device, console: Console) -> FrameMirror | None:
    """The mirror of the table's frames on the GPU or in this host's memory; None if it is off or there is no room."""
    if not mirrors(config, spec):
        return None
    if device.type == "cuda":
        slots, room = table_slots(config, spec), MIRROR_SHARE * torch.cuda.mem_get_info(device)[0] // frame_bytes(spec)
        if slots <= room:
            return DeviceMirror(spec, slots, device)
        console.event(f"the mirror of the table is in the host's memory; the GPU has room for {room:,.0f} of {slots:,}")
    slots, most = mirror_slots(config, spec), config.most_held
    if slots < most:
        console.event(f"the mirror of the table has room for {slots:,} of {most:,} frames")
    return FrameMirror(spec, slots) if slots else None


def _exported(address: str, service: LearnerService) -> AbstractContextManager[object]:
    """Serve the learner's status to Prometheus; nothing if the address is empty."""
    if not address:
        return nullcontext()
    from coop.monitor.exporter import exported  # noqa: PLC0415 (an extra)

    return exported(address, service.status)


def _check_origin(found: Survey) -> None:
    """Raise UsageError for a checkpoint of a lockstep run, before anything is written."""
    if found.newest is not None and "episodes_received" not in found.newest.state:
        raise UsageError(f"{found.newest.path}: saved by a lockstep run; coop-lockstep --resume goes on with it")
