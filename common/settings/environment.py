"""Settings of a run's environment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from coop.common.bounds import MAX_ENV_ID, MAX_FRAME_SKIP, MAX_GAME_STEPS, MAX_NOOPS, MAX_SIDE, MAX_STACK
from coop.common.settings.fields import NONE, Table

Side = Annotated[int, Meta(gt=0, le=MAX_SIDE)]


@dataclass(frozen=True)
class EnvSettings:
    """The environment that the run plays."""

    id: Annotated[str, Meta(min_length=1, max_length=MAX_ENV_ID)] = "CartPole-v0"
    """A gymnasium id ("CartPole-v0", "my_envs:Room-v0" of the module my_envs) or an ALE game ("breakout")."""
    kwargs: Table = field(default_factory=dict, hash=False)
    """Keyword arguments of the environment, a TOML table, such as {side = 12}; not for ALE games."""
    vectorization_mode: Annotated[Literal["sync", "async", "vector_entry_point"] | None, NONE] = None
    """Play the emulators of an actor in one vector environment, as gymnasium.make_vec makes it; not for ALE games."""
    noop_max: Annotated[int, Meta(ge=0, le=MAX_NOOPS)] = 30
    """Largest number of no-ops at the start of a game, which is drawn from 0..noop_max; ALE only."""
    episodic_life: bool = False
    """Treat a lost life as terminal for learning while the game goes on (Mnih et al. 2015, training); ALE only."""
    clip_rewards: bool = False
    """Learn from rewards clipped to [-1, 1]; reported returns are unclipped."""
    frame_skip: Annotated[int, Meta(gt=0, le=MAX_FRAME_SKIP)] = 4
    """Emulator frames per step, of which the last two are max-pooled; ALE only."""
    stack: Annotated[int, Meta(gt=0, le=MAX_STACK)] = 1
    """Frames per observation."""
    resize: Annotated[tuple[Side, Side] | None, NONE] = None
    """Height and width to which pictures are resized; ALE games always have 84 x 84."""
    grayscale: bool = False
    """Convert colour pictures to grayscale; ALE games always are."""
    repeat_action_probability: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    """Probability that the emulator repeats the previous action (sticky actions); ALE only."""
    full_action_space: bool = False
    """Use all 18 actions instead of the game's minimal set; ALE only."""
    max_episode_steps: Annotated[int, Meta(ge=0, le=MAX_GAME_STEPS)] = 0
    """Truncate episodes after this many steps; 0 keeps the environment's own limit (ALE: 108,000 frames)."""
    time_limit_terminal: bool = False
    """Treat the time limit's end of an episode as terminal, as old gym did; otherwise the last state bootstraps."""

    @property
    def atari(self) -> bool:
        """Whether the id names an ALE game: in namespace ALE/, or with neither a module, a slash nor a version."""
        return self.id.startswith("ALE/") or not any(part in self.id for part in (":", "/", "-v"))

    @property
    def module(self) -> str | None:
        """The module that registers the id ("my_envs" of "my_envs:Room-v0"); None if it names none."""
        module, colon, _ = self.id.rpartition(":")
        return module if colon else None
