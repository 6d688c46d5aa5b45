"""`coop-learner`: the head of a run, which everybody else asks."""

from __future__ import annotations

import time
from dataclasses import dataclass

from common.envs.make import env_spec
from common.errors import RunError
from common.messaging.clients import SampleClient
from common.messaging.transport import Node, locators, new_incarnation, open_session
from common.process.lifecycle import Stop, run_main
from common.process.threads import use_threads
from common.settings.capacity import check_messages
from common.settings.config import check_distributed
from common.settings.options import RunOptions, parse_run
from learner.agent import Agent
from learner.checkpoints import Checkpoints
from learner.reception import Reception
from learner.records.epochs import go_back
from learner.records.run_directory import RunDirectory
from learner.roster import Roster
from learner.service import LearnerService
from learner.trainer import Trainer


@dataclass(frozen=True)
class LearnerOptions(RunOptions):
    """Flags of `coop-learner`."""

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints to listen on; tcp/0.0.0.0:7447 opens the run to other machines."""


def main() -> None:
    """Entry point."""
    run_main("coop-learner", _run)


def _run() -> None:
    options = parse_run(
        LearnerOptions, "coop-learner", "Train the networks of a run; everybody else asks this process."
    )
    config = options.run_config()
    check_distributed(config)
    spec = env_spec(config.env)
    check_messages(config, spec)
    use_threads(config.learner.threads)
    stop = Stop()
    stop.on_signals()
    stop.on_thread_failures()
    path = options.directory()
    trainer = Trainer(Agent(config, spec), time.monotonic())
    agent = trainer.agent
    state = go_back(path) if options.resume else None
    if state is not None:
        trainer.load_state(state, time.monotonic())
    incarnation = new_incarnation()
    session = open_session(options.listen, (), options.zenoh_config, options.shared_memory)
    sizes = None if state is None else state["sizes"]
    with Node(session, config.run, "learner", incarnation) as node, RunDirectory(path, config, sizes) as directory:
        settings, told = config.learner, 0 if state is None else state["told"]
        samples = SampleClient(
            node, stop, incarnation, spec, settings.batch_size, settings.prefetch, agent.updates, told
        )
        checkpoints = Checkpoints(node, path, samples)
        run_id = directory.run_id()
        roster = Roster(path, time.monotonic())
        Reception(node, config, spec, agent.networks[0].layout_digest(), run_id, lambda: checkpoints.newest, roster)
        print(f"run {config.run!r} listens on {', '.join(locators(session))}; files in {path}", flush=True)
        if state is not None:
            print(f"goes on from epoch {agent.updates}", flush=True)
        summary = LearnerService(node, stop, trainer, directory, samples, checkpoints).run()
    print(summary, flush=True)
    if trainer.diverged:
        raise RunError(trainer.diverged)
    if stop.failed:
        raise RunError(stop.reason)
