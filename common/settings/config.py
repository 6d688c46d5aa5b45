"""The configuration of a run: nested dataclasses whose fields say what they may hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

import tyro
from pydantic import ConfigDict, Field

from common.bounds import (
    MAX_AHEAD,
    MAX_BATCH,
    MAX_GAPS,
    MAX_LAYERS,
    MAX_N_STEP,
    MAX_RATIO,
    MAX_SEGMENT_STEPS,
    MAX_STREAMS,
    MAX_TOLERANCE,
)
from common.errors import UsageError
from common.settings.environment import EnvSettings
from common.settings.fields import Count, Decay, NonNegative, Positive, PositiveFloat, PositiveShare, Share, Steps

OptimizerName = Literal["sgd", "rmsprop", "rmsprop-mnih", "adam"]
Method = Literal["dqn", "edql", "g-coop", "coop"]
METHODS: tuple[Method, ...] = get_args(Method)  # in the order of the paper's table

_STRICT = ConfigDict(extra="forbid")


@dataclass(frozen=True)
class NetworkSettings:
    """The Q-network."""

    __pydantic_config__ = _STRICT
    kind: Literal["mlp", "nature", "nips2013"] = "mlp"
    """mlp: Linear layers with ReLU; nature: 3 conv + 2 linear; nips2013: 2 conv + 2 linear."""
    hidden: Annotated[tuple[Positive, ...], Field(max_length=MAX_LAYERS)] = (128, 128, 128)
    """Widths of the hidden layers of the mlp."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """bfloat16: actor processes, targets, and all passes of the gradient methods, with half the bits; parameters and
    optimizers stay in float32."""


@dataclass(frozen=True)
class LearnerSettings:
    """The update of the acting network."""

    __pydantic_config__ = _STRICT
    batch_size: Annotated[int, Field(gt=0, le=MAX_BATCH)] = 32
    swap_every: Positive = 30
    """C: updates between swaps of the acting role."""
    target_update_every: Positive | None = None
    """Updates between copies to the target network (dqn, edql); as swap_every if not given, so that all methods have
    one C."""
    swap_unit: Literal["updates", "steps"] = "updates"
    """What these two count; environment steps in lockstep runs only."""
    reset_role_at_episode: bool = False
    """Let network 1 act at the start of each episode, as Algorithm 1 writes it; lockstep runs only."""
    gamma: Share = 0.99
    loss: Literal["squared", "mse", "huber"] = "squared"
    """squared: 1/2 e^2, the paper's; mse: e^2, as PyTorch's and the authors' code, so s weighs half as much beside it;
    huber: 1/2 e^2 with its slope clipped to [-1, 1]."""
    double: bool = False
    """Take the target's value at the action that the trained network prefers, as in double Q-learning."""
    optimizer: OptimizerName = "rmsprop"
    """rmsprop is PyTorch's; rmsprop-mnih is centred, with eps inside the root, beside gradients summed over the
    batch."""
    learning_rate: PositiveFloat = 1e-3
    learning_rate_final: PositiveShare = 1.0
    """The learning rate falls exponentially to this share of itself over the whole run."""
    learning_rate_decay: PositiveShare = 1.0
    """The learning rate is also multiplied by this after every `learning_rate_decay_every` updates."""
    learning_rate_decay_every: Positive = 1000
    momentum: Decay = 0.0
    """Of the steps (sgd, rmsprop)."""
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
    weight_decay: Annotated[tuple[NonNegative, ...], Field(max_length=MAX_LAYERS + 1)] = ()
    """lambda(i) of each layer, input first; one value holds for all layers; none means 0."""
    device: str = "cpu"
    compile: bool = False
    """Run the passes through torch.compile, for GPUs; on a CPU that needs a C++ compiler and gains nothing."""
    threads: Positive = 1
    """CPU threads of torch in the learner."""
    prefetch: Annotated[int, Field(gt=0, le=MAX_AHEAD // 4)] = 4
    """Sample requests under way at once."""
    publish_every: Positive = 10
    """Updates between broadcasts of the acting network; every swap is broadcast too."""


@dataclass(frozen=True)
class EdlSettings:
    """Error-driven learning: B = U (S + s I) V^T."""

    __pydantic_config__ = _STRICT
    rate: NonNegative = 0.1
    """s at the first update, the paper's exploration rate; 0 gives the ordinary gradient."""
    decay: PositiveShare = 1.0
    """s is multiplied by this every `decay_every` updates."""
    decay_every: Positive = 1000
    decay_stepwise: bool = False
    """Multiply at once after `decay_every` updates; else a little with each update."""
    noise: Literal["constant", "normal"] = "constant"
    """normal: s is the rate times one draw from N(0, 1) per update."""
    feedback: Literal["transform", "weight-gradient", "random"] = "transform"
    polar_dtype: Literal["float32", "bfloat16"] = "float32"
    """What the s U V^T part of the transform feedback is computed in; T^T e is float32 always."""


@dataclass(frozen=True)
class ReplaySettings:
    """The replay table and its limiter."""

    __pydantic_config__ = _STRICT
    capacity: Steps = 5000
    """Exact number of transitions held."""
    learning_starts: Steps = 500
    """Transitions to collect before the first update; --total-steps cuts a preset's to a tenth of the run."""
    ratio: Annotated[float, Field(gt=0, le=MAX_RATIO)] = 1.0
    """Updates per environment step."""
    tolerance: Annotated[float, Field(gt=0, le=MAX_TOLERANCE)] = 64.0
    """Environment steps that acting and learning may drift apart."""
    n_step: Annotated[int, Field(gt=0, le=MAX_N_STEP)] = 1
    """Steps of reward that a transition sums up before it bootstraps (1: the paper); fewer at an episode's end."""
    eviction: Literal["fifo", "reservoir", "prioritized"] = "fifo"
    sampling: Literal["uniform", "prioritized"] = "uniform"
    replacement: bool = True
    """Draw a batch with replacement; without, it holds no transition twice (uniform sampling only)."""
    priority_exponent: Share = 0.6
    importance_exponent: Share = 0.4
    journal: bool = False
    """Write every accepted segment and every draw to disk before anybody is answered: a kill loses nothing."""
    journal_keep: bool = False
    """Keep journal files that an epoch covers, so that the run can be re-executed from its beginning."""

    @property
    def prioritized(self) -> bool:
        """Whether the table wants to be told of TD errors."""
        return "prioritized" in (self.eviction, self.sampling)


@dataclass(frozen=True)
class ActorSettings:
    """Acting: exploration and segments."""

    __pydantic_config__ = _STRICT
    envs: Annotated[int, Field(gt=0, le=MAX_STREAMS)] = 1
    """Emulators in one actor process."""
    epsilon_start: Share = 1.0
    epsilon_final: Share = 0.05
    epsilon_decay: Literal["exponential", "linear"] = "exponential"
    epsilon_steps: Steps = 10_000
    """Environment steps: time constant of the exponential, length of the linear decay."""
    segment_steps: Annotated[int, Field(gt=0, le=MAX_SEGMENT_STEPS)] = 16
    """Steps of one emulator that travel together."""
    window: Annotated[int, Field(gt=0, le=MAX_GAPS)] = 2
    """Segments an actor may have under way unacknowledged."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that defines a run; the same fields in TOML files and as flags."""

    __pydantic_config__ = _STRICT
    run: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,64}$")] = "coop"
    """Name of the run: roles with the same name find each other."""
    method: Method = "coop"
    seed: Count = 0
    total_steps: Steps = 50_000
    """Environment steps after which the run is complete."""
    total_updates: Count = 0
    """Stop after this many updates; 0: no limit."""
    total_episodes: Count = 0
    """Stop after this many finished episodes; 0: no limit."""
    target_return: Annotated[float, Field(allow_inf_nan=False)] | None = None
    """Stop once the mean return of the last 100 episodes reaches this."""
    checkpoint_every: Count = 10_000
    """Updates between epochs, the checkpoints of the whole system; 0: only the closing one."""
    env: EnvSettings = field(default_factory=EnvSettings)
    network: NetworkSettings = field(default_factory=NetworkSettings)
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    edl: EdlSettings = field(default_factory=EdlSettings)
    replay: ReplaySettings = field(default_factory=ReplaySettings)
    actor: ActorSettings = field(default_factory=ActorSettings)
    methods: Annotated[dict[Method, dict[str, Any]], tyro.conf.Fixed, tyro.conf.Suppress] = field(
        default_factory=dict, compare=False
    )
    """What the preset or file sets differently for other methods, for a run of theirs with this config."""

    @property
    def planned_updates(self) -> int:
        """Updates of a run that goes through all its steps: the ratio holds from `learning_starts` on."""
        return round(self.replay.ratio * (self.total_steps - self.replay.learning_starts))

    @property
    def two_networks(self) -> bool:
        """True for the cooperative methods, false where the second network is a copy of the first."""
        return self.method in ("g-coop", "coop")

    @property
    def swap_period(self) -> int:
        """C of this method, in `learner.swap_unit`: between swaps of the roles, or copies to the target network."""
        settings = self.learner
        return settings.swap_every if self.two_networks else settings.target_update_every or settings.swap_every

    @property
    def feedback(self) -> str:
        """The feedback of this method: "none" for the gradient methods."""
        return self.edl.feedback if self.method in ("edql", "coop") else "none"


def check_distributed(config: RunConfig) -> None:
    """Raises UsageError for what only lockstep runs can do: with many actors there is no single step or episode."""
    if config.learner.swap_unit == "steps":
        raise UsageError("learner.swap_unit = 'steps': in lockstep runs only; the roles' processes count updates")
    if config.learner.reset_role_at_episode:
        raise UsageError("learner.reset_role_at_episode = True: in lockstep runs only")
