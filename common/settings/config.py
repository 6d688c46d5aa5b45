"""The configuration of a run: nested dataclasses whose field types give the allowed values."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import Annotated, Any, Literal

import tyro
from msgspec import Meta

from coop.common.bounded import Counter, Real, Share
from coop.common.bounds import (
    MAX_AHEAD,
    MAX_BATCH,
    MAX_ENV_ID,
    MAX_EVALUATED,
    MAX_GAPS,
    MAX_LAYERS,
    MAX_N_STEP,
    MAX_RATIO,
    MAX_SEGMENT_STEPS,
    MAX_STREAMS,
    MAX_TOLERANCE,
)
from coop.common.errors import UsageError
from coop.common.numbers import updates_due
from coop.common.process.untrusted import RUN
from coop.common.settings.environment import EnvSettings
from coop.common.settings.fields import (
    NONE,
    SWITCH,
    Decay,
    NonNegative,
    Positive,
    PositiveFloat,
    PositiveShare,
    Steps,
)
from coop.common.settings.methods import METHODS
from coop.common.settings.names import EvictionName, MethodName, SamplingName
from coop.common.settings.policies import EVICTIONS, SAMPLERS

OUTSIDE = ("checkpoint_every", "eval_every", "eval_episodes", "video_every")  # training does not depend on these
OF_MACHINE = ("device", "threads", "mirror")  # of `learner`: a run may move to another machine
NETWORK_KINDS = ("mlp", "nature", "nips2013", "minatar")
OptimizerName = Literal["sgd", "rmsprop", "rmsprop-mnih", "adam"]

OF_REGISTRIES = ("method", "replay.eviction", "replay.sampling")
MAY_NAME_MODULES = ("env.id", "network.kind", *OF_REGISTRIES)  # as "module:name"


@dataclass(frozen=True)
class NetworkSettings:
    """The Q-network."""

    kind: Annotated[str, Meta(max_length=MAX_ENV_ID)] = "mlp"
    """mlp, nature (3 convolutions + 2 linear), nips2013 (2 + 2), minatar (1 + 2), or your own module:function."""
    hidden: Annotated[tuple[Positive, ...], Meta(max_length=MAX_LAYERS)] = (128, 128, 128)
    """Widths of the mlp's hidden layers."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """bfloat16 applies to acting, targets and all passes of an update; parameters stay in float32."""


@dataclass(frozen=True)
class LearnerSettings:
    """The update of the acting network."""

    batch_size: Annotated[int, Meta(gt=0, le=MAX_BATCH)] = 32
    """Transitions per update."""
    swap_every: Positive = 30
    """C: updates between swaps of the acting role."""
    target_update_every: Annotated[Positive | None, NONE] = None
    """C of methods with one network: updates between copies to the target network; default: swap_every."""
    tau: Annotated[PositiveShare | None, NONE] = None
    """Soft targets of methods with one network: after each update the target network moves by this share towards the
    trained one, in place of a copy every target_update_every."""
    swap_unit: Literal["updates", "steps"] = "updates"
    """Unit of swap_every and target_update_every; "steps" means environment steps, in lockstep runs only."""
    reset_role_at_episode: bool = False
    """Make network 1 the acting one at the start of each episode, as Algorithm 1 writes; lockstep runs only."""
    gamma: Share = 0.99
    """Discount factor."""
    loss: Literal["squared", "mse", "huber"] = "squared"
    """squared: 1/2 e^2 (paper); mse: e^2 (authors' code; halves the weight of s); huber: slope clipped to [-1, 1]."""
    double: bool = False
    """Double Q-learning: the trained network chooses the action at which the target network is evaluated."""
    reward_bound: Annotated[PositiveFloat | None, NONE] = None
    """Largest |reward| possible, if known: targets then take no value of a next state beyond +-this / (1 - gamma)."""
    optimizer: OptimizerName = "rmsprop"
    """Optimizer; rmsprop-mnih: centred, eps inside the square root, gradients summed over the batch; else PyTorch's."""
    learning_rate: PositiveFloat = 1e-3
    """Learning rate at the first update."""
    learning_rate_final: PositiveShare = 1.0
    """The learning rate falls exponentially to this share of itself over the whole run."""
    learning_rate_decay: PositiveShare = 1.0
    """The learning rate is also multiplied by this after every `learning_rate_decay_every` updates."""
    learning_rate_decay_every: Positive = 1000
    """Updates between multiplications by `learning_rate_decay`."""
    momentum: Decay = 0.0
    """Momentum of the parameter steps (sgd, rmsprop)."""
    alpha: Decay = 0.99
    """Smoothing constant of the squared gradients' running mean (rmsprop, rmsprop-mnih)."""
    gradient_alpha: Decay = 0.95
    """Smoothing constant of the gradients' running mean, Mnih's gradient momentum (rmsprop-mnih)."""
    beta1: Decay = 0.9
    """Smoothing constant of the gradients' running mean (adam)."""
    beta2: Decay = 0.999
    """Smoothing constant of the squared gradients' running mean (adam)."""
    eps: PositiveFloat = 1e-8
    """Added to the optimizer's denominator; not for sgd."""
    weight_decay: Annotated[tuple[NonNegative, ...], Meta(max_length=MAX_LAYERS + 1)] = ()
    """lambda(i) of each layer, starting at the input; one value applies to all layers; empty means 0."""
    initial_networks: str = ""
    """Folder of a run, with whose newest networks this run begins; empty: random weights."""
    device: str = "cpu"
    """PyTorch device of the networks, for example cpu or cuda."""
    tf32: bool = True
    """Let a GPU's matrix units read float32 numbers with 10 bits of mantissa; not where exactness needs more."""
    threads: Positive = 1
    """CPU threads that PyTorch uses in the learner."""
    prefetch: Annotated[int, Meta(gt=0, le=MAX_AHEAD // 4)] = 8
    """Batches that are asked for ahead."""
    mirror: Literal["auto", "on", "off"] = "auto"
    """on: keep copies of the table's frames, in at most a quarter of the memory, so that each is sent once; auto: of
    frames of 64 bytes or more."""
    publish_every: Positive = 10
    """Updates between broadcasts of the acting network; every swap is broadcast too."""

    @property
    def value_bound(self) -> float | None:
        """The largest |value| that `reward_bound` allows; None if there is no bound."""
        return None if self.reward_bound is None or self.gamma == 1 else self.reward_bound / (1 - self.gamma)


@dataclass(frozen=True)
class EdlSettings:
    """Error-driven learning: B = U (S + s I) V^T."""

    rate: NonNegative = 0.1
    """s at the first update, the paper's exploration rate; 0 gives the ordinary gradient."""
    decay: PositiveShare = 1.0
    """Factor by which s is multiplied every `decay_every` updates."""
    decay_every: Positive = 1000
    """Updates per application of `decay`."""
    decay_staircase: bool = False
    """Apply the whole factor once every `decay_every` updates, instead of a fraction of it at each update."""
    noise: Literal["constant", "normal"] = "constant"
    """normal: s is the rate times one draw from N(0, 1) per update."""
    feedback: Literal["transform", "weight-gradient", "random"] = "transform"
    """U, S and V: of each layer's Jacobian (transform), of its weight gradient, or a fixed random B instead."""


@dataclass(frozen=True)
class ReplaySettings:
    """The replay table and its limiter."""

    capacity: Steps = 5000
    """Exact number of transitions in the full table."""
    learning_starts: Steps = 500
    """Transitions to collect before the first update; unless given, at most the capacity and a tenth of the run, and as
    few as possible with `preload`."""
    ratio: Annotated[float, Meta(gt=0, le=MAX_RATIO)] = 1.0
    """Updates per environment step."""
    tolerance: Annotated[float, Meta(gt=0, le=MAX_TOLERANCE)] = 64.0
    """Environment steps by which acting may be ahead of learning, or behind it."""
    n_step: Annotated[int, Meta(gt=0, le=MAX_N_STEP)] = 1
    """Rewards that a transition sums before it bootstraps (1: the paper); fewer at the end of an episode."""
    eviction: EvictionName = "fifo"
    """Policy by which a full table evicts transitions; prioritized evicts the lowest priority."""
    sampling: SamplingName = "uniform"
    """Policy by which batches are drawn."""
    replacement: bool = True
    """Draw batches with replacement; without it, a batch holds no transition twice (uniform sampling only)."""
    priority_exponent: Share = 0.6
    """alpha of prioritized sampling; 0 draws uniformly."""
    importance_exponent: Share = 0.4
    """beta of the importance-sampling weights; 0 corrects nothing, 1 corrects fully."""
    journal: Annotated[Literal["off", "async", "sync"], SWITCH] = "off"
    """Write each accepted segment and each draw to a file before answering, so that the kill of a process loses none.
    async (the flag alone): the death of the machine may lose those since the newest checkpoint; sync: none, since
    segments are on the disk before they are acknowledged."""
    journal_keep: bool = False
    """Keep journal files that a checkpoint has made redundant: the run can then be re-executed from its beginning."""
    preload: str = ""
    """Transitions that the table holds before the first step: a Parquet file of coop-export, or the folder of a Minari
    data set; the process of the table reads it."""
    offline: bool = False
    """Learn from `preload` alone: no emulator plays, and total_steps counts the steps that updates stand for, by the
    ratio."""

    @cached_property
    def prioritized(self) -> bool:
        """Whether the table uses TD errors as priorities."""
        return EVICTIONS.get(self.eviction).priorities or SAMPLERS.get(self.sampling).priorities


@dataclass(frozen=True)
class ActorSettings:
    """Exploration and segments."""

    num_envs: Annotated[int, Meta(gt=0, le=MAX_STREAMS)] = 1
    """Emulators in one actor process."""
    epsilon_start: Share = 1.0
    """Probability of a random action at the run's beginning."""
    epsilon_final: Share = 0.05
    """Probability of a random action at the end of the decay."""
    epsilon_decay: Literal["exponential", "linear"] = "linear"
    """Shape of the decay of epsilon."""
    epsilon_steps: Steps = 5000
    """Steps: time constant of the exponential decay, length of the linear one; default: total_steps / 10."""
    segment_steps: Annotated[int, Meta(gt=0, le=MAX_SEGMENT_STEPS)] = 16
    """Steps of one emulator that are sent together."""
    max_in_flight: Annotated[int, Meta(gt=0, le=MAX_GAPS)] = 2
    """Unacknowledged segments that an actor may have in flight, for each emulator; many actors get fewer."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that defines a run; the same fields in TOML files and as flags."""

    run: Annotated[str, Meta(pattern=RUN.replace("$", r"\Z"))] = "coop"
    """Name of the run: roles with the same name find each other."""
    method: MethodName = "coop"
    """Training method."""
    seed: Counter = 0
    """Seed of all random numbers."""
    total_steps: Steps = 50_000
    """Environment steps of the run."""
    total_updates: Counter = 0
    """Stop after this many updates; 0: no limit."""
    total_episodes: Counter = 0
    """Stop after this many finished episodes; 0: no limit."""
    target_return: Annotated[Real | None, NONE] = None
    """Stop once the mean return of the last 100 episodes reaches this."""
    checkpoint_every: Counter = 10_000
    """Updates between checkpoints of the whole system; 0: only at the end."""
    eval_every: Counter = 0
    """Environment steps between evaluations: the acting network plays full episodes greedily; 0: none."""
    eval_episodes: Annotated[int, Meta(gt=0, le=MAX_EVALUATED)] = 10
    """Episodes of each evaluation."""
    video_every: Counter = 0
    """Environment steps between videos of an episode that the acting network plays greedily; 0: none."""
    env: EnvSettings = field(default_factory=EnvSettings)
    network: NetworkSettings = field(default_factory=NetworkSettings)
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    edl: EdlSettings = field(default_factory=EdlSettings)
    replay: ReplaySettings = field(default_factory=ReplaySettings)
    actor: ActorSettings = field(default_factory=ActorSettings)
    method_settings: Annotated[Any, tyro.conf.Fixed, tyro.conf.Suppress] = None
    """The method's own settings, an instance of `Method.settings`; files and flags have them under `Method.table`."""
    methods: Annotated[dict[str, dict[str, Any]], tyro.conf.Fixed, tyro.conf.Suppress] = field(
        default_factory=dict, compare=False
    )
    """Settings that the preset or file changes for other methods, kept for running them with this config."""

    @property
    def imports(self) -> dict[str, str]:
        """The settings that name a module to import, with their values ("module:name")."""
        named = ((name, _at(self, name)) for name in MAY_NAME_MODULES)
        return {field: value for field, value in named if ":" in value}

    @cached_property
    def planned_updates(self) -> int:
        """Updates of a run of all `total_steps`: the ratio applies from `learning_starts` on."""
        start = 0 if self.replay.offline else self.replay.learning_starts
        return updates_due(self.replay.ratio, self.total_steps - start)

    @cached_property
    def most_held(self) -> int:
        """The most transitions that the table of this run can hold."""
        return self.replay.capacity if self.replay.preload else min(self.replay.capacity, self.total_steps)

    @cached_property
    def two_networks(self) -> bool:
        """True for the cooperative methods; False if the second network is a copy of the first."""
        return METHODS.get(self.method).two_networks

    @cached_property
    def streaming(self) -> bool:
        """True for methods that learn from each step once and have no replay buffer."""
        return METHODS.get(self.method).stream is not None

    @cached_property
    def swap_period(self) -> int:
        """C of this method, in `learner.swap_unit`: the period of role swaps, or of copies to the target network."""
        settings = self.learner
        return settings.swap_every if self.two_networks else settings.target_update_every or settings.swap_every

    @cached_property
    def soft_targets(self) -> float | None:
        """`learner.tau` of a method with one network; None if its target network is copied, or it has none."""
        return None if self.two_networks else self.learner.tau

    @cached_property
    def feedback(self) -> str:
        """The feedback of this method: "none" for the gradient methods."""
        return self.edl.feedback if METHODS.get(self.method).error_driven else "none"


def _at(config: RunConfig, name: str) -> Any:  # noqa: ANN401 (a value of any field)
    """The value of a field by its dotted name."""
    return reduce(getattr, name.split("."), config)


def value_of(config: RunConfig, name: str) -> Any:  # noqa: ANN401 (a value of any field)
    """The value of a setting by its dotted name; None for one of another method, 0 for the capacity of no buffer."""
    if name == "replay.capacity" and config.streaming:
        return 0
    section, _, field_name = name.partition(".")
    if section == METHODS.get(config.method).table:
        return getattr(config.method_settings, field_name, None)
    value = getattr(config, section, None)
    return getattr(value, field_name) if field_name and value is not None else value


def check_distributed(config: RunConfig) -> None:
    """Raise UsageError for settings of lockstep runs only: with many actors there is no single step or episode."""
    if config.streaming:
        raise UsageError(f"method = {config.method!r}: in lockstep runs only; it has no replay buffer to share")
    if config.learner.swap_unit == "steps":
        raise UsageError("learner.swap_unit = 'steps': in lockstep runs only; the roles' processes count updates")
    if config.learner.reset_role_at_episode:
        raise UsageError("learner.reset_role_at_episode = True: in lockstep runs only")
