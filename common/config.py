"""The configuration of a run: nested dataclasses, presets, TOML files and the checks they all pass through."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
import tomli_w
from pydantic import ConfigDict, Field

from common.environments import EnvSettings
from common.errors import UsageError

OptimizerName = Literal["sgd", "rmsprop", "rmsprop-mnih", "adam"]
Method = Literal["dqn", "edql", "g-coop", "coop"]
Positive = Annotated[int, Field(gt=0)]
Count = Annotated[int, Field(ge=0)]
PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

_STRICT = ConfigDict(extra="forbid")


@dataclass(frozen=True)
class NetworkSettings:
    """The Q-network."""

    __pydantic_config__ = _STRICT
    kind: Literal["mlp", "nature", "nips2013"] = "mlp"
    """mlp: Linear layers with ReLU; nature: 3 conv + 2 linear; nips2013: 2 conv + 2 linear."""
    hidden: tuple[Positive, ...] = (128, 128, 128)
    """Widths of the hidden layers of the mlp."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """bfloat16: actor processes, targets, and all passes of the gradient methods, with half the bits; parameters and
    optimizers stay in float32."""


@dataclass(frozen=True)
class LearnerSettings:
    """The update of the acting network."""

    __pydantic_config__ = _STRICT
    batch_size: Positive = 32
    swap_every: Positive = 30
    """C: updates (or plays) between swaps of the acting role, or between copies to the target network."""
    swap_by: Literal["updates", "plays"] = "updates"
    """What C counts; plays (environment steps) exist in lockstep runs only."""
    reset_role_at_episode: bool = False
    """Let network 1 act at the start of each episode, as Algorithm 1 writes it; lockstep runs only."""
    gamma: Share = 0.99
    loss: Literal["squared", "huber"] = "squared"
    double: bool = False
    """Take the target's value at the action that the trained network prefers, as in double Q-learning."""
    optimizer: OptimizerName = "rmsprop"
    """rmsprop is PyTorch's; rmsprop-mnih is centred, with the constant inside the root."""
    learning_rate: PositiveFloat = 1e-3
    learning_rate_final: Annotated[float, Field(gt=0, le=1)] = 1.0
    """The learning rate falls exponentially to this share of itself over the whole run."""
    momentum: Annotated[float, Field(ge=0, lt=1)] = 0.0
    squared_decay: Annotated[float, Field(ge=0, lt=1)] = 0.99
    """Decay of the running mean of squared gradients (rmsprop, adam)."""
    denominator: PositiveFloat = 1e-8
    """Constant added to the optimizer's denominator."""
    weight_decay: tuple[NonNegative, ...] = ()
    """lambda(i) of each layer, input first; one value holds for all layers; none means 0."""
    device: str = "cpu"
    threads: Positive = 1
    """CPU threads of torch in the learner."""
    prefetch: Annotated[int, Field(gt=0, le=256)] = 4
    """Sample requests under way at once."""
    publish_every: Positive = 10
    """Updates between broadcasts of the acting network; every swap is broadcast too."""


@dataclass(frozen=True)
class EdlSettings:
    """Error-driven learning: B = U (S + s I) V^T."""

    __pydantic_config__ = _STRICT
    rate: NonNegative = 0.1
    """s at the first update, the paper's exploration rate; 0 gives the ordinary gradient."""
    decay: Annotated[float, Field(gt=0, le=1)] = 1.0
    """s is multiplied by this every `decay_every` updates."""
    decay_every: Positive = 1000
    noise: Literal["constant", "normal"] = "constant"
    """normal: s is the rate times one draw from N(0, 1) per update."""
    feedback: Literal["transform", "weight-gradient", "random"] = "transform"
    polar_dtype: Literal["float32", "bfloat16"] = "float32"
    """What the s U V^T part of the transform feedback is computed in; T^T e is float32 always."""


@dataclass(frozen=True)
class ReplaySettings:
    """The replay table and its limiter."""

    __pydantic_config__ = _STRICT
    capacity: Positive = 5000
    """Exact number of transitions held."""
    start: Positive = 500
    """Transitions to collect before the first update; --total-steps cuts a preset's to a tenth of the run."""
    ratio: PositiveFloat = 1.0
    """Updates per environment step."""
    tolerance: PositiveFloat = 64.0
    """Environment steps that acting and learning may drift apart."""
    eviction: Literal["fifo", "reservoir", "prioritized"] = "fifo"
    sampling: Literal["uniform", "prioritized"] = "uniform"
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
    envs: Positive = 1
    """Emulators in one actor process."""
    epsilon_start: Share = 1.0
    epsilon_final: Share = 0.05
    epsilon_decay: Literal["exponential", "linear"] = "exponential"
    epsilon_steps: Positive = 10_000
    """Environment steps: time constant of the exponential, length of the linear decay."""
    segment_steps: Positive = 16
    """Steps of one emulator that travel together."""
    window: Positive = 2
    """Segments an actor may have under way unacknowledged."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that defines a run; the same fields in TOML files and as flags."""

    __pydantic_config__ = _STRICT
    run: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,64}$")] = "coop"
    """Name of the run: roles with the same name find each other."""
    method: Method = "coop"
    seed: Count = 0
    total_steps: Positive = 50_000
    """Environment steps after which the run is complete."""
    total_updates: Count = 0
    """Stop after this many updates; 0: no limit."""
    total_episodes: Count = 0
    """Stop after this many finished episodes; 0: no limit."""
    target_return: float | None = None
    """Stop once the mean return of the last 100 episodes reaches this."""
    checkpoint_every: Count = 10_000
    """Updates between epochs, the checkpoints of the whole system; 0: only the closing one."""
    env: EnvSettings = field(default_factory=EnvSettings)
    network: NetworkSettings = field(default_factory=NetworkSettings)
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    edl: EdlSettings = field(default_factory=EdlSettings)
    replay: ReplaySettings = field(default_factory=ReplaySettings)
    actor: ActorSettings = field(default_factory=ActorSettings)

    @property
    def planned_updates(self) -> int:
        """Updates of a run that goes through all its steps: the ratio holds from the first `start` steps on."""
        return round(self.replay.ratio * (self.total_steps - self.replay.start))

    @property
    def two_networks(self) -> bool:
        """True for the cooperative methods, false where the second network is a copy of the first."""
        return self.method in ("g-coop", "coop")

    @property
    def feedback(self) -> str:
        """The feedback of this method: "none" for the gradient methods."""
        return self.edl.feedback if self.method in ("edql", "coop") else "none"


_ADAPTER = pydantic.TypeAdapter(RunConfig)


def preset_names() -> list[str]:
    """The presets that come with the package."""
    return sorted(entry.name.removesuffix(".toml") for entry in files("common").joinpath("presets").iterdir())


def load_tables(preset: str | None, path: Path | None) -> dict[str, Any]:
    """Read a preset or a config file as nested tables.

    Raises:
        UsageError: an unknown preset, or a file that is missing or not TOML.
    """
    if path is not None:
        try:
            return tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise UsageError(f"--config {path}: {error}") from error
    if preset not in preset_names():
        raise UsageError(f"--preset {preset}: unknown; allowed: {', '.join(preset_names())}")
    return tomllib.loads(files("common").joinpath("presets", f"{preset}.toml").read_text(encoding="utf-8"))


def shortened(tables: Mapping[str, Any], total_steps: int) -> dict[str, Any]:
    """A preset for a run of another length: its `replay.start` is at most a tenth of the run, so that it learns."""
    replay = tables.get("replay", {})
    start = min(replay.get("start", ReplaySettings.start), max(1, total_steps // 10))
    return {**tables, "total_steps": total_steps, "replay": {**replay, "start": start}}


def resolve(tables: Mapping[str, Any], method: str | None = None) -> RunConfig:
    """Turn tables into a checked config; a `[methods.NAME]` table overrides the rest for that method.

    Raises:
        UsageError: a misspelt field or a value out of range; names the field, the value and what is allowed.
    """
    merged = {key: value for key, value in tables.items() if key != "methods"}
    if method is not None:
        merged["method"] = method
    chosen = merged.get("method", RunConfig.method)
    for section, overrides in tables.get("methods", {}).get(chosen, {}).items():
        merged[section] = {**merged.get(section, {}), **overrides}
    return validated(merged)


def validated(tables: Mapping[str, Any] | RunConfig) -> RunConfig:
    """Check every field and the rules between fields.

    Raises:
        UsageError: as `resolve`.
    """
    try:
        config = _ADAPTER.validate_python(asdict(tables) if isinstance(tables, RunConfig) else tables)
    except pydantic.ValidationError as error:
        raise UsageError(first_problem(error, RunConfig())) from error
    replay = config.replay
    if replay.start > replay.capacity:
        raise UsageError(f"replay.start = {replay.start}: must not exceed replay.capacity = {replay.capacity}")
    if replay.journal_keep and not replay.journal:
        raise UsageError("replay.journal_keep = True: needs replay.journal = True")
    if replay.start > config.total_steps:
        raise UsageError(f"replay.start = {replay.start}: must not exceed total_steps = {config.total_steps}")
    return config


def check_distributed(config: RunConfig) -> None:
    """Raises UsageError for what only lockstep runs can do: with many actors there is no single play or episode."""
    if config.learner.swap_by == "plays":
        raise UsageError("learner.swap_by = 'plays': in lockstep runs only; the roles' processes count updates")
    if config.learner.reset_role_at_episode:
        raise UsageError("learner.reset_role_at_episode = True: in lockstep runs only")


def to_toml(config: RunConfig) -> str:
    """The resolved config as TOML; `--config` takes it back."""
    return tomli_w.dumps(_without_none(asdict(config)))


def to_tables(config: RunConfig) -> dict[str, Any]:
    """The resolved config as plain nested tables, for the wire."""
    return _without_none(asdict(config))


def identity(config: RunConfig) -> dict[str, Any]:
    """What makes two runs the same one, as nested tables: everything but how often it is saved."""
    return {name: value for name, value in to_tables(config).items() if name != "checkpoint_every"}


def first_difference(here: Mapping[str, Any], there: Mapping[str, Any], name: str = "") -> tuple[str, Any, Any] | None:
    """(name, here, there) of the first field in which nested tables differ; None where they are equal."""
    for key in {**here, **there}:
        mine, theirs = here.get(key), there.get(key)
        if isinstance(mine, Mapping) and isinstance(theirs, Mapping):
            if found := first_difference(mine, theirs, f"{name}{key}."):
                return found
        elif mine != theirs:
            return f"{name}{key}", mine, theirs
    return None


def _without_none(tables: Mapping[str, Any]) -> dict[str, Any]:
    """TOML has no null: a field that is None is left out and comes back as its default."""
    return {
        key: _without_none(value) if isinstance(value, Mapping) else value
        for key, value in tables.items()
        if value is not None
    }


def first_problem(error: pydantic.ValidationError, example: Any) -> str:  # noqa: ANN401 (any nested dataclasses)
    """What pydantic found first, in one line: the field, the value and what is allowed.

    example: an instance of what was to be built, for the names of its fields.
    """
    first, *rest = error.errors(include_url=False)
    name = ".".join(str(part) for part in first["loc"])
    if first["type"] == "unexpected_keyword_argument":
        allowed = ", ".join(_siblings(first["loc"], example))
        text = f"{name} = {first['input']!r}: no such field; allowed: {allowed}"
    else:
        text = f"{name} = {first['input']!r}: {first['msg'][0].lower()}{first['msg'][1:]}"
    return f"{text} (and {len(rest)} more)" if rest else text


def _siblings(path: tuple[int | str, ...], example: Any) -> list[str]:  # noqa: ANN401
    """The fields that are allowed where the last name of `path` stands."""
    for name in path[:-1]:
        example = getattr(example, str(name))
    return [field.name for field in fields(example)]
