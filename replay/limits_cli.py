"""`coop-limits`: shows the limiter of a running replay service, and changes it."""

from __future__ import annotations

from dataclasses import dataclass

from coop.common.errors import RunError
from coop.common.messaging.joining import join
from coop.common.messaging.keys import replay_key
from coop.common.messaging.messages.control import Join, Limit, Limits, LimitsQuestion
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import NoAnswer, Node, Refused, new_incarnation
from coop.common.process import cli
from coop.common.process.lifecycle import Stop, run_main
from coop.common.settings.options import RoleOptions


@dataclass(frozen=True)
class LimitsOptions(RoleOptions):
    """Flags of `coop-limits`."""

    ratio: float | None = None
    """New ratio of updates per environment step, from now on; unchanged if not given."""
    tolerance: float | None = None
    """New tolerance in environment steps between acting and learning; unchanged if not given."""


def main() -> None:
    """Entry point."""
    run_main("coop-limits", _run)


def _run() -> None:
    options = cli.parse(LimitsOptions, "coop-limits", "Show or change a run's limiter of acting and learning.")
    stop = Stop()
    stop.on_signals()
    request = Join("watch", new_incarnation(), [])  # asks for the replay service's endpoints
    with Node(open_session((), options.connect, options.zenoh_config), options.run, "watch", 0) as node:
        reply = join(node, stop, request, options.connect, options.join_timeout, need_replay=True)
    if reply is None:
        return
    endpoints = (*options.connect, *reply.replay_endpoints)
    with Node(open_session((), endpoints, options.zenoh_config), node.run, "watch", 0) as node:
        now = _ask(node, LimitsQuestion().encode(node.run))
        if options.ratio is not None or options.tolerance is not None:
            ratio = now.ratio if options.ratio is None else options.ratio
            tolerance = now.tolerance if options.tolerance is None else options.tolerance
            now = _ask(node, Limit(ratio, tolerance).encode(node.run))
    print(f"ratio {now.ratio:g}, tolerance {now.tolerance:g} steps")
    print(f"{now.inserted:,} transitions, {now.drawn:,} batches of {now.planned:,}")
    print(f"inserts: {now.inserts_wait_for or 'admitted'}; samples: {now.samples_wait_for or 'admitted'}")


def _ask(node: Node, question: bytearray) -> Limits:
    try:
        return Limits.decode(node.ask(replay_key(node, "limits"), question))
    except NoAnswer as error:
        raise RunError(f"the replay service of run {node.run_name!r} does not answer") from error
    except Refused as error:
        raise RunError(f"the replay service refused: {error}") from error
