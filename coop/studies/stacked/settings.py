"""The settings of a stack of runs, and its schedules as arrays; imports no environment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from coop.common.errors import UsageError
from coop.common.settings import schedules

if TYPE_CHECKING:
    from coop.common.settings.config import RunConfig

TWO_NETWORKS = {"dqn": False, "edql": False, "g-coop": True, "coop": True}
# "noise", "matched" and "parallel" are controls of a study: see `coop.studies.stacked.networks`.
FEEDBACKS = ("none", "transform", "weight-gradient", "random", "noise", "matched")
OPTIMIZERS = ("sgd", "rmsprop", "adam")
MAX_BATCH = 240

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class StackSettings:
    """What the runs of a stack have in common; the names and meanings are those of `RunConfig`'s fields.

    hidden: number of hidden layers, each `width` wide. feedback: one of FEEDBACKS. value_bound: of targets, or None.
    Learning rate, rate of s and optimizer differ between runs: see `Runs`.
    """

    method: str = "dqn"
    feedback: str = "none"
    total_steps: int = 20_000
    hidden: int = 3
    width: int = 128
    batch_size: int = 32
    swap_every: int = 30
    gamma: float = 0.99
    loss: str = "squared"
    double: bool = True
    value_bound: float | None = None
    learning_rate_final: float = 1.0
    learning_rate_decay: float = 1.0
    learning_rate_decay_every: int = 1000
    alpha: float = 0.99
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-8
    decay: float = 1.0
    decay_every: int = 1000
    decay_staircase: bool = False
    noise: str = "constant"
    capacity: int = 5000
    learning_starts: int = 128
    eviction: str = "fifo"
    epsilon_start: float = 0.9
    epsilon_final: float = 0.05
    epsilon_decay: str = "exponential"
    epsilon_steps: int = 200
    time_limit: int = 200
    time_limit_terminal: bool = False

    def __post_init__(self) -> None:
        """Raise UsageError for a value without a meaning here."""
        allowed = {
            "method": tuple(TWO_NETWORKS), "feedback": FEEDBACKS, "loss": ("squared", "mse", "huber"),
            "noise": ("constant", "normal"), "eviction": ("fifo", "reservoir"),
        }  # fmt: skip
        for name, values in allowed.items():
            if getattr(self, name) not in values:
                raise UsageError(f"{name} = {getattr(self, name)!r}: allowed in a stack: {', '.join(values)}")
        if not 0 < self.batch_size <= MAX_BATCH:
            raise UsageError(f"batch_size = {self.batch_size}: allowed in a stack: 1 to {MAX_BATCH}")
        if not 0 < self.learning_starts <= min(self.capacity, self.total_steps):
            raise UsageError(f"learning_starts = {self.learning_starts}: allowed: 1 to the capacity and the steps")
        if self.width < 2 or self.hidden < 1:
            raise UsageError(f"hidden = {self.hidden} layers of {self.width}: at least one, of at least 2 units")

    @property
    def two_networks(self) -> bool:
        """Whether the second network is no copy of the first."""
        return TWO_NETWORKS[self.method]

    @property
    def updates(self) -> int:
        """Updates of a whole run: one for each step after the first `learning_starts`."""
        return self.total_steps - self.learning_starts

    def role(self, update: int) -> int:
        """The network that update `update`, from 0, trains."""
        return update // self.swap_every % 2 if self.two_networks else 0

    @cached_property
    def epsilons(self) -> Floats:
        """Probability of a random action before each step: float64 [total_steps]."""
        ours = cast(Any, self)
        return np.array([schedules.epsilon(ours, step) for step in range(self.total_steps)])

    @cached_property
    def rates(self) -> Floats:
        """The share of the first learning rate at each update: float64 [updates]."""
        ours = cast(Any, _Scaled(self))
        return np.array([schedules.learning_rate(ours, update, self.updates) for update in range(self.updates)])

    @cached_property
    def exploration_rates(self) -> Floats:
        """The share of the first s at each update, before a draw from N(0, 1): float64 [updates]."""
        ours = cast(Any, _Scaled(self))
        return np.array([schedules.feedback_scale(ours, update) for update in range(self.updates)])

    @cached_property
    def corrections(self) -> tuple[Floats, Floats]:
        """Adam's corrections at each update: sqrt(1 - beta2^k) / (1 - beta1^k) and eps sqrt(1 - beta2^k), [updates].

        k: steps of the network that is trained, this one included.
        """
        roles = np.array([self.role(update) for update in range(self.updates)], np.int64)
        steps = np.where(roles == 0, np.cumsum(roles == 0), np.cumsum(roles == 1))
        root = (1 - self.beta2**steps) ** 0.5
        return root / (1 - self.beta1**steps), self.eps * root


@dataclass(frozen=True)
class _Scaled:
    """Settings for the schedules, with first values of 1."""

    settings: StackSettings
    learning_rate: float = 1.0
    rate: float = 1.0

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self.settings, name)


@dataclass(frozen=True)
class Runs:
    """What differs between the runs of a stack: arrays [K].

    seeds: int64. rates: float64, learning rates at the first update. s: float64, rates of s at the first update.
    optimizers: (name, number of runs), of OPTIMIZERS, in the order of the runs.
    """

    seeds: NDArray[np.int64]
    rates: Floats
    s: Floats
    optimizers: tuple[tuple[str, int], ...]

    def __post_init__(self) -> None:
        """Raise UsageError for arrays of different lengths or an unknown optimizer."""
        counts = {len(self.seeds), len(self.rates), len(self.s), sum(count for _, count in self.optimizers)}
        if len(counts) != 1 or 0 in counts:
            raise UsageError(f"runs of a stack: seeds, rates, s and optimizers have {sorted(counts)} entries")
        for name, _ in self.optimizers:
            if name not in OPTIMIZERS:
                raise UsageError(f"optimizer = {name!r}: allowed in a stack: {', '.join(OPTIMIZERS)}")

    @staticmethod
    def of(seeds: list[int], optimizer: str, rate: float, s: float) -> Runs:
        """Runs that differ in their seeds alone."""
        count = len(seeds)
        return Runs(np.array(seeds), np.full(count, rate), np.full(count, s), ((optimizer, count),))


def from_config(config: RunConfig) -> tuple[StackSettings, Runs]:
    """The settings of one run of lockstep, and the run.

    Raises:
        UsageError: a setting that a stack has no form for.
    """
    learner, edl, replay, actor, network = config.learner, config.edl, config.replay, config.actor, config.network
    fixed = (
        ("env.id", config.env.id, "CartPole-v0"), ("network.kind", network.kind, "mlp"),
        ("replay.ratio", replay.ratio, 1.0),
        ("network.dtype", network.dtype, "float32"), ("replay.sampling", replay.sampling, "uniform"),
        ("replay.replacement", replay.replacement, True), ("replay.n_step", replay.n_step, 1),
        ("replay.preload", replay.preload, ""),
        ("learner.momentum", learner.momentum, 0.0), ("learner.weight_decay", learner.weight_decay, ()),
        ("learner.swap_unit", learner.swap_unit, "updates"), ("actor.num_envs", actor.num_envs, 1),
        ("learner.reset_role_at_episode", learner.reset_role_at_episode, False),
        ("learner.initial_networks", learner.initial_networks, ""),
    )  # fmt: skip
    for name, value, allowed in fixed:
        if value != allowed:
            raise UsageError(f"{name} = {value!r}: a stack has {allowed!r} only")
    if config.method not in TWO_NETWORKS or learner.optimizer not in OPTIMIZERS or len(set(network.hidden)) != 1:
        raise UsageError("a stack has the methods dqn, edql, g-coop and coop, sgd, rmsprop and adam, and equal layers")
    shared = {
        name: getattr(part, name)
        for part in (learner, edl, replay, actor)
        for name in StackSettings.__dataclass_fields__
        if hasattr(part, name) and name not in ("hidden", "feedback", "swap_every")
    }
    settings = StackSettings(
        method=config.method, feedback=config.feedback, total_steps=config.total_steps,
        hidden=len(network.hidden), width=network.hidden[0], swap_every=config.swap_period,
        time_limit_terminal=config.env.time_limit_terminal, **shared,
    )  # fmt: skip
    s = 0.0 if config.feedback == "none" else edl.rate
    return settings, Runs.of([config.seed], learner.optimizer, learner.learning_rate, s)
