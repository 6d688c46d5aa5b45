"""The processes of a simulated run: the product's conversations, each begun as its command begins it."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np

from benchmarks.simulate.agent import FewNumbers, Numbers
from benchmarks.simulate.network import Network
from benchmarks.simulate.node import RUN, SimNode
from benchmarks.simulate.world import Process
from coop.actors.weights import WeightsFollower
from coop.common.errors import RunError
from coop.common.messaging.conversation import Conversation
from coop.common.messaging.insert_client import InsertClient
from coop.common.messaging.joining import Membership, joining, leaving
from coop.common.messaging.members import ROUTE
from coop.common.messaging.messages.control import Join, JoinReply
from coop.common.messaging.messages.evaluate import Evaluated, EvaluationRow
from coop.common.messaging.route import ReplayRoute
from coop.common.process.files import FileDigest
from coop.common.settings.config import RunConfig
from coop.common.transitions import Segment
from coop.common.types import EnvSpec, EpisodeEnd
from coop.evaluation.evaluator import reporting
from coop.learner.process import training_run
from coop.learner.trainer import Trainer
from coop.records.checkpoints import RECORDS
from coop.records.learner_checkpoints import load_learner
from coop.records.resumption import Start, go_back
from coop.records.run_ids import claim, has_run_id, read_run_id
from coop.replay.cli import serving_run

SPEC = EnvSpec("numbers", (1,), "float32", 1, 2)
STEPS = 4  # of a segment
LEARNER = "tcp/learner:1"
STRANGER = "tcp/elsewhere:1"  # where the learner of another run of the same name listens
JOIN_TIMEOUT = 60.0  # seconds, as in the product
PATIENCE = 60.0  # seconds
ACTOR_NUMBERS = 4096  # transitions of one actor process, so that all have numbers of their own


class Lines:
    """The console of a role, whose lines go to the trace."""

    def __init__(self, process: Process) -> None:
        self._process = process

    def event(self, text: str) -> None:
        """See `Console`."""
        self._process.world.tell(self._process.name, "says:", text)
        self._process.world.said(self._process, text)

    def recent(self) -> list[Any]:
        """See `Console`."""
        return []

    def progress(self, count: int, reason: str, line: Callable[[], str]) -> None:
        """See `Console`."""


class Directory:
    """The run directory as far as checkpoints need it: records and curves are no part of the protocol."""

    def __init__(
        self,
        recorded: Callable[[Path, EvaluationRow], None],
        path: Path,
        config: RunConfig,
        found: Any,  # noqa: ANN401
        number: int | None,
        steps: int,
        *,
        log: object,
    ) -> None:
        self._recorded = recorded
        self.path, self.settings, self.fallbacks, self.aside, self.evaluated = path, "", [], "", 0
        newest = None if found is None or number is None else found.of(number)
        for name in RECORDS:
            (path / name).touch()
        if found is not None:
            try:
                self.aside = go_back(found, number)
            except OSError as error:
                raise RunError(f"{path}: {error}") from error
        if newest is not None:
            self.fallbacks = [*newest.manifest.fallbacks, *found.fallbacks(newest.number)]
        self.summary: Any = None

    def run_id(self) -> int:
        """See `RunDirectory`."""
        return read_run_id(self.path)

    def records(self) -> dict[str, FileDigest]:
        """See `RunDirectory`."""
        return dict.fromkeys(RECORDS, FileDigest(0, 0))

    def record(self, episodes: object, metrics: object) -> None:
        """See `RunDirectory`."""

    def evaluation(self, row: EvaluationRow) -> None:
        """See `RunDirectory`."""
        self._recorded(self.path, row)

    def conclude(self, summary: Any, title: str) -> None:  # noqa: ANN401
        """See `RunDirectory`."""

    def draw(self, title: str) -> None:
        """See `RunDirectory`."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open."""


def claim_directory(draw: random.Random, path: Path, config: RunConfig, known: int | None = None) -> int:
    """As `claim_run_directory`."""
    run_id = read_run_id(path) if has_run_id(path) else draw.getrandbits(63) if known is None else known
    claim(path, run_id)
    return run_id


def learner(
    network: Network,
    process: Process,
    config: RunConfig,
    path: Path,
    at: str,
    locked: Callable[[], AbstractContextManager[object]],
    trainer_kind: type[Trainer],
    incarnation: int,
) -> Conversation[Any]:
    """As `coop-learner --resume`, at an endpoint; locked: takes the lock of its folder."""
    console, stop = Lines(process), process.stop
    with locked():
        found, notices = Start(resume=True).prepare(path, replay=False, load=load_learner, every=True)
        for line in notices:
            console.event(line)
        trainer = trainer_kind(FewNumbers(config, SPEC), process.now())
        node = SimNode(network, process, "learner", incarnation, listen=at)
        options = SimpleNamespace(restart=False, shared_memory=False, prometheus="", log="")
        return (yield from training_run(node, stop, trainer, found, options, [at], console))


def replay(
    network: Network, process: Process, path: Path, at: str, connect: Sequence[str], incarnation: int
) -> Conversation[None]:
    """As `coop-replay --resume`; connect: endpoints of learners, here and below."""
    node = SimNode(network, process, "replay", incarnation, listen=at, connect=connect)
    options: Any = SimpleNamespace(
        run=RUN,
        connect=(),
        join_timeout=JOIN_TIMEOUT,
        run_dir=path,
        resume=True,
        advertise=(),
        shared_memory=False,
        patience=PATIENCE,
    )
    yield from serving_run(node, process.stop, options, [at], Lines(process))


class Route(ReplayRoute):
    """An actor's route, over the simulated network."""

    def __init__(
        self, network: Network, process: Process, run: str, incarnation: int, endpoints: Sequence[str]
    ) -> None:
        self._make = partial(SimNode, network, process, ROUTE, incarnation, run=run)
        super().__init__(run, incarnation, lambda endpoints: None, endpoints)  # type: ignore[arg-type,return-value]

    def _open(self, endpoints: Sequence[str]) -> Any:  # noqa: ANN401
        return self._make(connect=list(endpoints))

    def _retire(self, node: Any) -> None:  # noqa: ANN401
        node.close()


class Policy:
    """What an actor acts with."""

    def __init__(self) -> None:
        self.networks = (Numbers(-1), Numbers(-1))
        self.acting = 0


def make_segment(incarnation: int, number: int, sequence: int, version: int) -> Segment:
    """The next steps of an actor; each transition holds a number that no other has."""
    first = number * ACTOR_NUMBERS + sequence * STEPS
    frames = np.arange(first, first + STEPS + 1, dtype=np.float32).reshape(-1, 1)
    index = np.arange(STEPS, dtype=np.int32)[:, None]
    return Segment(
        incarnation=incarnation,
        stream=0,
        sequence=sequence,
        frames=frames,
        obs_index=index,
        next_index=index + 1,
        actions=np.zeros(STEPS, np.int32),
        rewards=frames[:-1, 0].copy(),
        terminated=np.zeros(STEPS, np.bool_),
        param_version=np.full(STEPS, version, np.int64),
        span=np.ones(STEPS, np.uint8),
        carried=min(sequence, 1),
        episodes=(EpisodeEnd(STEPS - 1, float(first), STEPS, 0.1, 0.2, 0.3, version),),
    )


def actor(
    network: Network,
    process: Process,
    connect: Sequence[str],
    number: int,
    incarnation: int,
    every: float,
    window: int,
    look: Callable[[Process, WeightsFollower, Policy], None],
    sent: Callable[[Segment], None],
) -> Conversation[None]:
    """As `coop-actor`: joins, follows the weights, sends segments, leaves.

    every: seconds of a segment's steps. look, sent: called after each look at the weights, and for each segment.
    """
    stop, console = process.stop, Lines(process)
    node: Any = SimNode(network, process, "actor", incarnation, connect=connect)
    node.follow_stop(stop)
    request = Join("actor", incarnation, [])
    reply = yield from joining(node, request, (), JOIN_TIMEOUT, need_replay=True, event=console.event)
    if reply is not None:
        policy = Policy()
        route = Route(network, process, node.run, incarnation, reply.replay_endpoints)
        weights = WeightsFollower(node, policy)  # type: ignore[arg-type]
        inserts = InsertClient(route, stop, window)
        process.state.update(policy=policy, weights=weights, inserts=inserts)

        def learned(answer: JoinReply, _: float) -> None:
            route.follow(answer.replay_endpoints)

        with Membership(node, stop, request, reply, PATIENCE, learned, console.event, lambda: route.is_up):
            sequence = 0
            while not stop.is_set():
                yield from weights.refreshing()
                look(process, weights, policy)
                if weights.ready:
                    segment = make_segment(incarnation, number, sequence, weights.version)
                    sent(segment)
                    sequence += 1
                    if not (yield from inserts.submitting(segment)):
                        break
                if (yield every):
                    break
    yield from leaving(node, request)


def evaluator(
    network: Network, process: Process, connect: Sequence[str], incarnation: int, every: float
) -> Conversation[None]:
    """As `coop-eval --connect`: follows the weights and reports what they are worth."""
    stop, console = process.stop, Lines(process)
    node: Any = SimNode(network, process, "evaluator", incarnation, connect=connect)
    node.follow_stop(stop)
    request = Join("evaluator", incarnation, [])
    reply = yield from joining(node, request, (), JOIN_TIMEOUT, event=console.event)
    if reply is not None:
        policy, number = Policy(), 0
        weights = WeightsFollower(node, policy)  # type: ignore[arg-type]
        with Membership(node, stop, request, reply, PATIENCE, lambda answer, now: None, console.event):
            while not (yield every):
                yield from weights.refreshing()
                if weights.settled:
                    update, env_step = weights.progress
                    row = EvaluationRow(
                        env_step, update, 1, 1, 1.0, 0.0, 0.0, float(incarnation % 10**6 * 100 + number)
                    )
                    yield from reporting(node, stop, Evaluated(incarnation, number, row).encode(node.run))
                    number += 1
    yield from leaving(node, request)
