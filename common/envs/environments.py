"""What every environment gives an actor: a batch of emulators stepped together, exact about how episodes end.

Emulators are imported where they are made, so that a process that only reads the settings does not pay for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from common.errors import UsageError
from common.types import Array, EnvSpec


@dataclass(frozen=True, slots=True)
class EnvSettings:
    """The environment that a run plays; the config file's [env] table.

    id: a gymnasium id ("CartPole-v0", "coop/Catch-v0") or an ALE game ("breakout", "ALE/Breakout-v5").
    noop_max: no-ops at the start of a game are drawn from 0..noop_max. ALE only, as are the next two and the last two.
    episodic_life: a lost life is terminal for learning while the game goes on (Mnih et al. 2015, training).
    frame_skip: emulator frames of one step; the last two are max-pooled.
    clip_rewards: learn from rewards clipped to [-1, 1]; reported returns are unclipped.
    stack: frames of one observation; pictures only, a vector is its own observation.
    max_episode_steps: truncate after so many steps; 0 keeps the environment's own limit (ALE: 108,000 frames).
    repeat_action_probability: sticky actions. full_action_space: all 18 actions in place of the game's own.
    """

    id: str = "CartPole-v0"
    noop_max: int = 30
    episodic_life: bool = False
    clip_rewards: bool = False
    frame_skip: int = 4
    stack: int = 4
    repeat_action_probability: float = 0.0
    full_action_space: bool = False
    max_episode_steps: int = 0


@dataclass(frozen=True, slots=True)
class Steps:
    """One step of every emulator. Receivers must not write into the arrays; none is reused by a later call.

    obs: <frame_dtype>[envs, *obs_shape], what the policy acts on next (of the new episode where one began).
    next_obs: <frame_dtype>[envs, *obs_shape], where the step led; the same object as `obs` if nothing restarted.
    rewards: float32 [envs], for learning. raw_rewards: float64 [envs], unclipped, for reported returns.
    terminated: bool [envs], for learning: no value follows. A truncated step is not terminal.
    restarted: bool [envs], obs does not continue next_obs, for the emulator was reset.
    episode_over: bool [envs], the reported (full-game) episode ended.
    """

    obs: Array
    next_obs: Array
    rewards: NDArray[np.float32]
    raw_rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    restarted: NDArray[np.bool_]
    episode_over: NDArray[np.bool_]


class VectorEnv(Protocol):
    """`num_envs` emulators that step together and reset themselves."""

    spec: EnvSpec
    num_envs: int

    def reset(self) -> Array:
        """Start every emulator from its seed: <frame_dtype>[envs, *obs_shape]."""

    def send(self, actions: NDArray[np.int32]) -> None:
        """Begin to play one action, int32 [envs] in 0..num_actions-1, in every emulator; `recv` must follow."""

    def recv(self) -> Steps:
        """What the actions sent last led to."""

    def step(self, actions: NDArray[np.int32]) -> Steps:
        """`send`, then `recv`."""

    def close(self) -> None:
        """Free the emulators."""


def make_vector_env(settings: EnvSettings, num_envs: int, seed: int) -> VectorEnv:
    """Make `num_envs` emulators, each with a seed of its own drawn from `seed`.

    Raises:
        UsageError: unknown id or game, a space that does not fit, or a setting out of range.
    """
    _check(settings)
    if num_envs < 1:
        raise UsageError(f"envs: {num_envs} is not allowed; at least 1")
    seeds = np.random.SeedSequence(seed).generate_state(num_envs) & 0x7FFFFFFF  # ALE takes 31 bits
    if (game := _atari_game(settings.id)) is not None:
        from common.envs.atari import AtariEnv  # noqa: PLC0415

        return AtariEnv(settings, game, seeds.tolist())
    from common.envs.gymnasium_env import GymnasiumEnv  # noqa: PLC0415

    return GymnasiumEnv(settings, seeds.tolist())


def env_spec(settings: EnvSettings) -> EnvSpec:
    """The specification of the environment, without starting emulators.

    Raises:
        UsageError: as `make_vector_env`.
    """
    _check(settings)
    if (game := _atari_game(settings.id)) is not None:
        from common.envs.atari import atari_spec  # noqa: PLC0415

        return atari_spec(settings, game)
    from common.envs.gymnasium_env import gymnasium_spec  # noqa: PLC0415

    return gymnasium_spec(settings)


def _check(settings: EnvSettings) -> None:
    allowed = {
        "noop_max": (settings.noop_max >= 0, "at least 0"),
        "frame_skip": (settings.frame_skip >= 1, "at least 1"),
        "stack": (settings.stack >= 1, "at least 1"),
        "max_episode_steps": (settings.max_episode_steps >= 0, "at least 0 (0: the environment's own limit)"),
        "repeat_action_probability": (0 <= settings.repeat_action_probability < 1, "in [0, 1)"),
    }
    for name, (fits, what) in allowed.items():
        if not fits:
            raise UsageError(f"env.{name}: {getattr(settings, name)} is not allowed; {what}")


def _atari_game(env_id: str) -> str | None:
    """The ROM's name if `env_id` means an ALE game; None leaves the id to gymnasium.

    Ids with a slash or a version are gymnasium's, except ALE's own namespace; the rest are games.
    """
    if not env_id.startswith("ALE/") and ("/" in env_id or "-v" in env_id):
        return None
    from ale_py.roms import get_all_rom_ids  # noqa: PLC0415

    games = {game.replace("_", ""): game for game in get_all_rom_ids()}
    wanted = env_id.removeprefix("ALE/").split("-v")[0]
    plain = wanted.replace("_", "").replace("-", "").lower()
    if plain in games:
        return games[plain]
    near = ", ".join(games[name] for name in get_close_matches(plain, games, n=3)) or "breakout, pong, space_invaders"
    raise UsageError(f"env.id: unknown game {wanted!r}; ale-py has {len(games)} games, such as {near}")
