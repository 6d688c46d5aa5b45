"""The settings of the environment that a run plays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import ConfigDict, Field

from common.bounds import MAX_ENV_ID, MAX_FRAME_SKIP, MAX_GAME_STEPS, MAX_NOOPS, MAX_STACK


@dataclass(frozen=True)
class EnvSettings:
    """The environment that the run plays."""

    __pydantic_config__ = ConfigDict(extra="forbid")
    id: Annotated[str, Field(min_length=1, max_length=MAX_ENV_ID)] = "CartPole-v0"
    """A gymnasium id ("CartPole-v0", "coop/Catch-v0") or an ALE game ("breakout", "ALE/Breakout-v5")."""
    noop_max: Annotated[int, Field(ge=0, le=MAX_NOOPS)] = 30
    """No-ops at the start of a game are drawn from 0..noop_max; ALE only."""
    episodic_life: bool = False
    """A lost life is terminal for learning while the game goes on (Mnih et al. 2015, training); ALE only."""
    clip_rewards: bool = False
    """Learn from rewards clipped to [-1, 1]; reported returns are unclipped."""
    frame_skip: Annotated[int, Field(gt=0, le=MAX_FRAME_SKIP)] = 4
    """Emulator frames of one step, the last two of them max-pooled; ALE only."""
    stack: Annotated[int, Field(gt=0, le=MAX_STACK)] = 4
    """Frames of one observation; pictures only, a vector is its own observation."""
    repeat_action_probability: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Sticky actions; ALE only."""
    full_action_space: bool = False
    """All 18 actions in place of the game's own; ALE only."""
    max_episode_steps: Annotated[int, Field(ge=0, le=MAX_GAME_STEPS)] = 0
    """Truncate after so many steps; 0 keeps the environment's own limit (ALE: 108,000 frames)."""
    time_limit_terminal: bool = False
    """An episode that its time limit ends counts as terminal for learning, as in old gym; else its last state has a
    value."""

    @property
    def atari(self) -> bool:
        """Whether the id means an ALE game: gymnasium's have a slash or a version, ALE's own namespace excepted."""
        return self.id.startswith("ALE/") or not ("/" in self.id or "-v" in self.id)
