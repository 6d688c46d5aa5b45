"""The process of an evaluator: joins a run, plays the networks that the learner broadcasts, and reports the returns."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from coop.actors.weights import WeightsFollower, make_policy
from coop.common.envs.make import check_filmed
from coop.common.errors import UsageError
from coop.common.messaging.conversation import Conversation, asking, drive
from coop.common.messaging.joining import Membership, join, leave_run
from coop.common.messaging.keys import evaluations_key
from coop.common.messaging.messages.control import Join, JoinReply
from coop.common.messaging.messages.evaluate import Evaluated, Video
from coop.common.messaging.session import open_session
from coop.common.messaging.timing import ANSWER_TIMEOUT, LAST_RECEIPT, RECEIPT_PAUSE
from coop.common.messaging.transport import NoAnswer, Node, Refused, new_incarnation
from coop.common.process.console import Console, counted
from coop.common.process.lifecycle import Stop
from coop.common.process.limits import use_threads
from coop.common.settings.options import RoleOptions
from coop.evaluation.episodes import AT_ONCE, Evaluator

LOOK_EVERY = 0.05  # seconds between looks at what the learner has broadcast


Progress = tuple[int, int]
"""Updates and environment steps of a run."""


@dataclass(frozen=True)
class EvaluationPlan:
    """What to evaluate, and when.

    seconds: between the beginnings of two evaluations; None: `steps` counts. steps: environment steps of the run
    between two evaluations; None: the run's `eval_every`. episodes: None: the run's `eval_episodes`.
    """

    seconds: float | None = None
    steps: int | None = None
    episodes: int | None = None
    epsilon: float = 0.0
    at_once: int = AT_ONCE


class Schedule:
    """When to evaluate or to film; time is an argument.

    seconds: between two beginnings, the first one at once; None: `steps` environment steps, 0: never.
    """

    def __init__(self, seconds: float | None, steps: int) -> None:
        self._seconds, self._steps = seconds, steps
        self._next_time = 0.0
        self._next_step: float = steps or math.inf
        self._last: int | None = None  # updates of the networks whose time came last

    def due(self, progress: Progress, now: float) -> bool:
        """Whether it is time for the networks of `progress`; those of equally many updates are the same.

        A run may go on for a few steps after its last update: none have two times.
        """
        if progress[0] == self._last:
            return False
        return now >= self._next_time if self._seconds is not None else progress[1] >= self._next_step

    def rush(self) -> None:
        """Make new networks due at once, if any ever are."""
        self._next_time = 0.0
        self._next_step = min(self._next_step, 0) if self._steps else self._next_step

    def begun(self, progress: Progress, now: float) -> None:
        """Note that the time of the networks of `progress` has come."""
        self._last = progress[0]
        if self._seconds is not None:
            self._next_time = now + self._seconds
        else:
            self._next_step = (progress[1] // self._steps + 1) * self._steps


def evaluate_run(options: RoleOptions, allow_import: tuple[str, ...], plan: EvaluationPlan) -> None:
    """Join a run and evaluate its acting network until the stop; after a complete run, its final one too."""
    use_threads(1)
    stop = Stop()
    stop.on_signals()
    stop.on_thread_failures()
    incarnation, console = new_incarnation(), Console()
    session = open_session((), options.connect, options.zenoh_config, options.shared_memory)
    with Node(session, options.run, "evaluator", incarnation) as node:
        node.follow_stop(stop)
        request = Join("evaluator", incarnation, [])
        try:
            reply = join(node, stop, request, options.connect, options.join_timeout, event=console.event)
            if reply is not None:
                service = EvaluatorService(node, stop, reply, allow_import, plan, incarnation, console)
                console.event(f"joined run {options.run!r} on {reply.learner}")
                with Membership(node, stop, request, reply, options.patience, lambda answer, now: None, console.event):
                    service.run()
        finally:
            leave_run(node, request)
    stop.raise_for_status()


class EvaluatorService:
    """Evaluates the acting network of a run again and again, and sends the results to the learner."""

    def __init__(
        self,
        node: Node,
        stop: Stop,
        reply: JoinReply,
        allow_import: tuple[str, ...],
        plan: EvaluationPlan,
        incarnation: int,
        console: Console,
    ) -> None:
        """Raise UsageError if nothing says how often, or the run can't be filmed; JoinError as `make_policy`."""
        steps, config = plan.steps or reply.config.eval_every, reply.config
        if plan.seconds is None and not (steps or config.video_every):
            raise UsageError("--every: needed, as the run has no eval_every")
        if config.video_every:
            check_filmed(config.env)
        self._policy = make_policy(reply, allow_import, np.random.default_rng(0))
        self._node, self._stop, self._console, self._incarnation = node, stop, console, incarnation
        self._weights = WeightsFollower(node, self._policy)
        self._evaluations, self._films = Schedule(plan.seconds, steps), Schedule(None, config.video_every)
        self._evaluator = Evaluator(config, self._abandons, plan.episodes, plan.epsilon, plan.at_once, console.event)
        self._number = 0
        self._last = False

    def run(self) -> None:
        """Evaluate until the stop."""
        while not self._stop.is_set():
            self._weights.refresh()
            if self._weights.settled:
                self._turn()
            self._stop.wait(LOOK_EVERY)
        if self._stop.reason.startswith("complete"):
            self._last = True
            self._evaluations.rush()
            ends = time.monotonic() + LAST_RECEIPT
            while not self._weights.fetch() and time.monotonic() < ends:
                time.sleep(RECEIPT_PAUSE)
            if self._weights.ready:
                self._turn()

    def _turn(self) -> None:
        """Evaluate and film if it is time."""
        progress, now, acting = self._weights.progress, time.monotonic(), self._policy.acting
        network, (update, env_step) = self._policy.networks[acting], progress
        if self._evaluations.due(progress, now):
            self._evaluations.begun(progress, now)
            result = self._evaluator.evaluate(network, acting + 1, update, env_step)
            if result is not None:
                mean, sd = f"{result.return_mean:.2f}", f"{result.return_sd:.2f}"
                said = f"return {mean} (sd {sd}) of {counted(result.episodes, 'episode')} after {env_step:,} steps"
                self._send(Evaluated(self._incarnation, self._number, result), said)
        if self._films.due(progress, now) and not self._abandons():
            self._films.begun(progress, now)
            if (gif := self._evaluator.film(network, env_step)) is not None:
                video = Video(self._incarnation, self._number, env_step, np.frombuffer(gif, np.uint8))
                self._send(video, f"a video after {env_step:,} steps")

    def _send(self, message: Evaluated | Video, said: str) -> None:
        """Send a result, see `reporting`, and say so."""
        payload = message.encode(self._node.run)
        self._number += 1
        self._console.event(said + drive(reporting(self._node, self._stop, payload)))

    def _abandons(self) -> bool:
        """Whether an evaluation has become useless."""
        return not self._node.presence.members("learner") if self._last else self._stop.is_set()


def reporting(node: Node, stop: Stop, payload: bytearray) -> Conversation[str]:
    """Send a result until it is acknowledged, or for `LAST_RECEIPT` seconds at the run's end; say if it was not."""
    ends = math.inf
    while True:
        try:
            yield from asking(node, evaluations_key(node), payload, ANSWER_TIMEOUT)
        except Refused as error:
            return f"; the learner refused it: {error}"
        except NoAnswer:
            ends = min(ends, node.now() + LAST_RECEIPT) if stop.is_set() else ends
            if node.now() >= ends:
                return "; the learner is gone"
            yield RECEIPT_PAUSE
        else:
            return ""
