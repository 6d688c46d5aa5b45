"""What a run needs, and what limits it: arithmetic from the measured costs of steps, updates, inserts and draws."""

from __future__ import annotations

import math
from dataclasses import dataclass

from common.errors import UsageError
from common.settings.capacity import NAME_BYTES, ROW_BYTES, estimated_bytes, frame_bytes
from common.settings.config import RunConfig
from common.settings.methods import METHODS
from common.types import EnvSpec

MIB = 2**20
LEARNER_BYTES = 400 * MIB  # resident
REPLAY_BYTES = 90 * MIB  # without its table (docs/benchmarks.md)
LINK_BYTES = 0.7 * MIB  # of either service, for each actor (benchmarks/fan_in.py)
HEADER_BYTES = 300  # of a message
COPIES = 6  # of the parameters: two networks, and two running means of each optimizer


@dataclass(frozen=True)
class Costs:
    """Processor time in milliseconds on a core of an Intel Xeon at 2 GHz; docs/scaling.md says how it was measured.

    step: of an actor, for one environment step. gradient, error_driven: an update of the learner, with receiving its
    batch. insert, draw: of the replay service, for one transition and for one batch. actor: resident MiB.
    """

    step: float
    gradient: float
    error_driven: float
    insert: float
    draw: float
    actor: float

    def update(self, method: str) -> float:
        """Of the learner, an update by a method; raises UsageError for one that was not measured."""
        if method not in MEASURED:
            raise UsageError(f"--method {method}: its updates have not been measured; allowed: {', '.join(MEASURED)}")
        return self.error_driven if METHODS.get(method).error_driven else self.gradient


MEASURED = ("dqn", "edql", "g-coop", "coop")
_MEASURED_COSTS = {
    ("breakout",): Costs(0.96, 53.1, 79.3, 0.0266, 1.91, 336),
    ("pong", "space-invaders"): Costs(0.873, 64.2, 84.2, 0.04, 2.17, 331),
    ("breakout-small",): Costs(1.11, 28.1, 41.2, 0.0375, 2.22, 308),
    ("pong-small", "space-invaders-small"): Costs(0.727, 26.4, 46.6, 0.0236, 2.15, 308),
    ("catch",): Costs(0.773, 32.7, 36.3, 0.0686, 2.2, 292),
    ("cartpole", "cartpole-paper", "cartpole-authors"): Costs(0.412, 2.9, 3.55, 0.352, 0.925, 77),
    ("minatar-asterix", "minatar-breakout", "minatar-freeway", "minatar-seaquest", "minatar-space-invaders"): Costs(
        0.262, 3.95, 5.76, 0.079, 1.05, 417
    ),
}
COSTS = {preset: costs for presets, costs in _MEASURED_COSTS.items() for preset in presets}


@dataclass(frozen=True)
class Part:
    """One part of a run.

    cores, memory: what it needs, in all; bytes. most: environment steps per second that it can carry.
    remedy: what to do where it is what limits the run.
    """

    name: str
    cores: int
    memory: float
    most: float
    remedy: str


@dataclass(frozen=True)
class Traffic:
    """Bytes per environment step between actors, replay service and learner."""

    inserts: float
    draws: float
    weights: float


@dataclass(frozen=True)
class Sizing:
    """What a run needs.

    parts: actors, replay service, learner, and the links of the two services' hosts.
    bandwidth: of each link in one direction, in bytes per second.
    """

    parts: tuple[Part, ...]
    traffic: Traffic
    bandwidth: float

    @property
    def bottleneck(self) -> Part:
        """The part that carries the fewest steps."""
        return min(self.parts, key=lambda part: part.most)

    @property
    def speed(self) -> float:
        """Environment steps per second of the whole run."""
        return self.bottleneck.most

    @property
    def weights_delivered(self) -> float:
        """Share of the broadcast parameters that the learner's link carries; the rest is dropped, never waited for."""
        return min(1.0, self.bandwidth / (self.speed * self.traffic.weights))


def size(
    costs: Costs,
    config: RunConfig,
    spec: EnvSpec,
    parameters: int,
    actors: int,
    learner_speedup: float = 1.0,
    gbits: float = 10.0,
) -> Sizing:
    """Size a run whose learner and replay service have a host each, and its actors a core each.

    Args:
        costs: of the config's preset. parameters: of one network.
        learner_speedup: how many times as fast as one measured core the learner computes.
        gbits: bandwidth of each of the two hosts, in each direction, in Gbit/s.

    Raises:
        UsageError: updates by the config's method have not been measured.
    """
    ratio, bandwidth = config.replay.ratio, gbits * 1e9 / 8
    traffic = _traffic(config, spec, parameters, actors)
    update = costs.update(config.method) / learner_speedup
    links = LINK_BYTES * actors
    held = min(config.replay.capacity, config.total_steps)
    table, mirror = estimated_bytes(spec, held), 0 if config.learner.mirror == "off" else held * (frame_bytes(spec) + 8)
    return Sizing(
        (
            Part(
                *("actors", actors, actors * costs.actor * MIB, actors * 1000 / costs.step),
                "more actors",
            ),
            Part(
                *("replay service", 1, REPLAY_BYTES + table + links, 1000 / (costs.insert + ratio * costs.draw)),
                "a lower --replay.ratio with a larger --learner.batch-size",
            ),
            Part(
                *("learner", 1, LEARNER_BYTES + mirror + 4 * parameters * COPIES + links, 1000 / (ratio * update)),
                "a faster learner, or a lower --replay.ratio; more actors gain nothing",
            ),
            Part(
                *("learner's link", 0, 0.0, bandwidth / traffic.draws),
                "learner and replay service on one host (--shared-memory)",
            ),
            Part(
                *("replay's link", 0, 0.0, bandwidth / max(traffic.inserts, traffic.draws)),
                "learner and replay service on one host (--shared-memory)",
            ),
        ),
        traffic,
        bandwidth,
    )


def enough_actors(sizing: Sizing) -> int:
    """The number of actors that keep the rest of the run busy; never more than it has."""
    actors = sizing.parts[0]
    return math.ceil(sizing.speed / actors.most * actors.cores)


def _traffic(config: RunConfig, spec: EnvSpec, parameters: int, actors: int) -> Traffic:
    """Bytes per environment step; a transition in a batch refers to stack + 1 frames, one in a segment brings one.

    With the learner's mirror, batches bring each frame once, and otherwise only its name.
    """
    row, frame = ROW_BYTES + 8 * spec.stack, frame_bytes(spec)
    width = 2 if config.network.dtype == "bfloat16" else 4
    learner, ratio = config.learner, config.replay.ratio
    drawn = ratio * learner.batch_size * (spec.stack + 1)  # frames
    mirrored = config.learner.mirror != "off"
    frames = min(drawn, 1) * frame + drawn * NAME_BYTES if mirrored else drawn * frame
    return Traffic(
        inserts=frame + row + HEADER_BYTES / config.actor.segment_steps,
        draws=frames + ratio * (learner.batch_size * row + HEADER_BYTES),
        weights=ratio / learner.publish_every * width * parameters * actors,
    )
