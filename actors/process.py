"""The process of an actor: joins a run, plays until the stop, and leaves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import zenoh

from coop.actors.cli import ActorOptions
from coop.actors.service import ActorService
from coop.actors.weights import make_policy
from coop.common.envs.make import make_vector_env
from coop.common.errors import JoinError
from coop.common.messaging.joining import Membership, join, leave_run
from coop.common.messaging.messages.control import Join, JoinReply
from coop.common.messaging.route import ReplayRoute, RoutedReplay, open_client
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node, new_incarnation
from coop.common.process.console import Console, counted
from coop.common.process.lifecycle import Stop
from coop.common.process.limits import use_threads
from coop.common.process.memory import keep_freed_memory
from coop.monitor.health import answering


def play(options: ActorOptions) -> None:
    """Join a run and play emulators for it until the stop."""
    use_threads(1)
    keep_freed_memory()
    if options.device != "cpu":
        from coop.common.networks.devices import usable_device  # noqa: PLC0415 (PyTorch, whose import takes seconds)

        usable_device(options.device, f"--device {options.device}")
    stop = Stop()
    stop.on_signals()
    stop.on_thread_failures()
    incarnation, console = new_incarnation(), Console()
    session = _open(options, stop)
    if session is None:
        stop.raise_for_status()
        return
    with Node(session, options.run, "actor", incarnation) as node, answering(options.health, console):
        node.follow_stop(stop)
        request = Join("actor", incarnation, [])
        try:
            reply = join(
                node, stop, request, options.connect, options.join_timeout, need_replay=True, event=console.event
            )
            if reply is not None:
                _play(node, stop, options, request, reply, console)
        finally:
            leave_run(node, request)
    stop.raise_for_status()


def _open(options: ActorOptions, stop: Stop) -> zenoh.Session | None:
    """Open the session; None if a stop was requested before there was a router. Raises JoinError."""
    connection = options.connect, options.zenoh_config, options.shared_memory
    if options.mode == "client":
        return open_client(*connection, options.join_timeout, stop)
    return open_session((), *connection)


def _play(node: Node, stop: Stop, options: ActorOptions, request: Join, reply: JoinReply, console: Console) -> None:
    """Play until the stop.

    Raises:
        JoinError: the run needs a module that this process may not import, or this process's environment or network
            differs from the learner's.
    """
    config = reply.config
    # The learner gives each number once per run, also across restarts, so no two processes play the same seeds.
    seed = np.random.SeedSequence([config.seed, 3, reply.index])
    env_seed, policy_seed = seed.spawn(2)
    policy = make_policy(reply, options.allow_import, np.random.default_rng(policy_seed), options.device)
    emulators = options.envs or config.actor.num_envs
    groups = max(1, min(options.groups or (1 if options.device == "cpu" else 2), emulators))
    sizes = [(emulators + group) // groups for group in range(groups)]
    envs = [
        make_vector_env(config.env, size, int(number))
        for size, number in zip(sizes, env_seed.generate_state(groups), strict=True)
    ]
    for env in envs:
        if env.spec != reply.spec:
            raise JoinError(f"environment here {env.spec}, the learner's {reply.spec}")

    def open_route(endpoints: Sequence[str]) -> zenoh.Session:
        return open_session((), endpoints, options.zenoh_config, options.shared_memory)

    with (
        RoutedReplay(node)
        if options.mode == "client"
        else ReplayRoute(node.run, request.incarnation, open_route, reply.replay_endpoints)
    ) as route:

        def learned(answer: JoinReply, _: float) -> None:
            route.follow(answer.replay_endpoints)

        console.event(
            f"joined run {options.run!r} on {reply.learner} as actor {reply.index}; "
            f"plays {counted(emulators, 'emulator')} of {config.env.id} for the replay service on {reply.replay}"
        )
        service = ActorService(node, route, stop, config, envs, policy, request.incarnation, console)
        with Membership(node, stop, request, reply, options.patience, learned, console.event, lambda: route.is_up):
            service.run()
    console.event(f"{stop.reason}; {service.progress()}")
    for env in envs:
        env.close()
