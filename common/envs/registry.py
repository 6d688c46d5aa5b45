"""Finds the environment that an id names: registered, in a module to import, or of an installed package."""

from __future__ import annotations

import re
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points

import gymnasium
from gymnasium.envs.registration import EnvSpec, namespace

from coop.common.envs import catch as _registers_catch  # noqa: F401
from coop.common.errors import UsageError
from coop.common.imports import describe, import_module
from coop.common.settings.environment import EnvSettings

_PACKAGES = {"MinAtar": "minatar"}  # known packages by the namespace of their ids
_ANY_NAMESPACE = "__root__"  # name of entry points that register ids of any namespace


def find_registered(settings: EnvSettings) -> EnvSpec:
    """The entry for the id in gymnasium's registry.

    Raises:
        UsageError: the id is unknown, or its module or package cannot be imported.
    """
    if settings.module is not None:
        import_module(settings.module, "env.id")
    name = settings.id.rpartition(":")[2]
    space = name.rpartition("/")[0]
    for point in entry_points(group="gymnasium.envs"):  # gymnasium 1 leaves them to its users
        if name not in gymnasium.registry and point.name in {space, _ANY_NAMESPACE}:
            try:
                _load(point)
            except Exception as error:
                text = f"env.id = {settings.id!r}: cannot load {point.value!r}: {describe(error)}"
                raise UsageError(text) from error
    try:
        found = gymnasium.spec(name)
    except gymnasium.error.Error:
        raise UsageError(_unknown(settings, name, space)) from None
    if str(found.entry_point).startswith("ale_py"):  # registered if something has imported ale-py
        raise UsageError(_unknown(settings, name, space))
    return found


def _game(name: str) -> str | None:
    """The ALE game of an id such as BreakoutNoFrameskip-v4, in which old versions of gym had its emulator; or None."""
    from ale_py.roms import get_all_rom_ids  # noqa: PLC0415

    plain = re.sub(r"(-ram)?(Deterministic|NoFrameskip)?-v\d+$", "", name).lower()
    return next((game for game in get_all_rom_ids() if game.replace("_", "") == plain), None)


@cache
def _load(point: EntryPoint) -> None:
    """Let an installed package register its environments, once."""
    register = point.load()
    if point.name == _ANY_NAMESPACE:
        register()
    else:
        with namespace(point.name):
            register()


def _unknown(settings: EnvSettings, name: str, space: str) -> str:
    asked = f"env.id: unknown environment {settings.id!r}"
    if space in _PACKAGES and not any(known.startswith(f"{space}/") for known in gymnasium.registry):
        return f"{asked}; ids of {space} need the package {_PACKAGES[space]}, which is not installed"
    if settings.module is None and (game := _game(name)) is not None:
        return (
            f"{asked}; ALE's game is {game!r} here, with env.frame_skip and env.repeat_action_probability for the rest"
        )
    near = ", ".join(get_close_matches(name, gymnasium.registry, n=3)) or "CartPole-v0, coop/Catch-v0"
    if settings.module is not None:
        return f"{asked}; the module {settings.module} does not register {name}; known are {near}"
    return f"{asked}; known are gymnasium's ids, such as {near}, ids of modules (my_envs:Room-v0), and ALE's games"
