"""Makes the environment that the settings name.

Emulators are imported only when they are made, so that a process that only reads the settings does not pay for them.
"""

from __future__ import annotations

from contextlib import closing
from difflib import get_close_matches

import numpy as np

from coop.common.envs.protocol import FilmedEnv, VectorEnv
from coop.common.errors import UsageError
from coop.common.process.output import warn_once
from coop.common.settings.environment import EnvSettings
from coop.common.types import EnvSpec

ALE_VERSION = "5"


def make_vector_env(settings: EnvSettings, num_envs: int, seed: int, *, bounded: bool = False) -> VectorEnv:
    """Make `num_envs` emulators, each with its own seed derived from `seed`.

    bounded: where nothing limits the length of an episode, cut it after `LONGEST_EPISODE` steps, and say so.

    Raises:
        UsageError: the id or game is unknown, or a space is not supported.
    """
    if num_envs < 1:
        raise UsageError(f"envs: {num_envs} is not allowed; at least 1")
    seeds = np.random.SeedSequence(seed).generate_state(num_envs) & 0x7FFFFFFF  # ALE takes 31 bits
    if (game := _atari_game(settings)) is not None:
        from coop.common.envs.atari import AtariEnv  # noqa: PLC0415

        return AtariEnv(settings, game, seeds.tolist())
    from coop.common.envs.gymnasium_env import GymnasiumEnv  # noqa: PLC0415

    return GymnasiumEnv(settings, seeds.tolist(), bounded=bounded)


def make_filmed_env(settings: EnvSettings, seed: int) -> FilmedEnv:
    """Make one emulator that shows pictures too, and plays episodes that are `bounded`.

    Raises:
        UsageError: as `make_vector_env`; or the environment has no pictures, or lacks a package for them.
    """
    (first,) = np.random.SeedSequence(seed).generate_state(1) & 0x7FFFFFFF
    if (game := _atari_game(settings)) is not None:
        from coop.common.envs.atari import FilmedAtari  # noqa: PLC0415

        return FilmedAtari(settings, game, int(first))
    from coop.common.envs.gymnasium_env import FilmedGymnasium  # noqa: PLC0415

    return FilmedGymnasium(settings, int(first))


def check_filmed(settings: EnvSettings) -> None:
    """Raise UsageError for an environment that can't be filmed here."""
    try:
        env = make_filmed_env(settings, 0)
        with closing(env):
            env.reset()
            env.picture()
    except UsageError as error:
        raise UsageError(f"video_every: {error}") from error


def env_spec(settings: EnvSettings) -> EnvSpec:
    """The specification of the environment, determined without starting emulators.

    Raises:
        UsageError: as `make_vector_env`.
    """
    if (game := _atari_game(settings)) is not None:
        from coop.common.envs.atari import atari_spec  # noqa: PLC0415

        return atari_spec(settings, game)
    from coop.common.envs.gymnasium_env import gymnasium_spec  # noqa: PLC0415

    return gymnasium_spec(settings)


def _check_version(settings: EnvSettings, version: str) -> None:
    """Raise UsageError for an id of gymnasium that does not exist; warn of one that there means sticky actions."""
    if version not in ("", ALE_VERSION):
        known = settings.id.removesuffix(version) + ALE_VERSION
        raise UsageError(f"env.id: unknown environment {settings.id!r}; ALE's ids have version 5: {known}")
    if version and not settings.repeat_action_probability:
        warn_once(
            f"env.id: {settings.id!r} has sticky actions elsewhere (probability 0.25), and none here unless "
            "env.repeat_action_probability is set"
        )


def _atari_game(settings: EnvSettings) -> str | None:
    """The ROM's name if the id names an ALE game; None if it is gymnasium's."""
    if not settings.atari:
        return None
    from ale_py.roms import get_all_rom_ids  # noqa: PLC0415

    games = {game.replace("_", ""): game for game in get_all_rom_ids()}
    wanted, _, version = settings.id.removeprefix("ALE/").partition("-v")
    plain = wanted.replace("_", "").replace("-", "").lower()
    if plain in games:
        _check_version(settings, version)
        return games[plain]
    near = ", ".join(games[name] for name in get_close_matches(plain, games, n=3)) or "breakout, pong, space_invaders"
    raise UsageError(f"env.id: unknown game {wanted!r}; ale-py has {len(games)} games, such as {near}")
