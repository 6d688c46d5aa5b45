"""What a run starts from: a preset, that of its environment, or neutral settings; and its settings in a line."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from coop.common.settings.config import RunConfig
from coop.common.settings.environment import EnvSettings
from coop.common.settings.overrides import leaves
from coop.common.settings.tables import base_tables, load_tables, preset_names


@cache
def preset_of(env_id: str) -> str | None:
    """The preset of an environment that comes with the package; None if there is none.

    Of several the one with the shortest name: cartpole, not cartpole-paper.
    """
    of_env = (name for name in preset_names() if load_tables(name, None)["env"]["id"] == env_id)
    return min(of_env, key=len, default=None)


def starting_tables(env_id: str | None) -> dict[str, Any]:
    """The settings of a run that names neither a preset nor a file.

    They are those of the preset of its environment (None: CartPole-v0); of another ALE game, those that the presets of
    Atari games share; of any other environment none, so the neutral defaults hold (`tables.resolve`).
    """
    env = EnvSettings() if env_id is None else EnvSettings(env_id)
    preset = preset_of(env.id)
    if preset is not None:
        return load_tables(preset, None)
    tables = base_tables("atari") if env.atari else {}
    return {**tables, "env": {**tables.get("env", {}), "id": env.id}}


def source_of(preset: str | None, file: object | None, resumed: bool, env_id: str) -> str:
    """Where a run's settings come from, in words."""
    if resumed and not (preset or file):
        return "of the resumed run"
    if file:
        return f"file {file}"
    if name := preset or preset_of(env_id):
        return f"preset {name}"
    return "no preset: those of the Atari presets" if EnvSettings(env_id).atari else "no preset: neutral"


def settings_line(config: RunConfig, source: str) -> str:
    """The settings that matter most, in one line; source: see `source_of`."""
    replay, network = config.replay, config.network
    table = (
        f"capacity {replay.capacity:,}, eviction {replay.eviction}, sampling {replay.sampling}, ratio {replay.ratio:g}"
    )
    parts = {
        "settings": source,
        "method": config.method,
        "gamma": f"{config.learner.gamma:g}",
        "replay": "no buffer" if config.streaming else table,
        "network": "-".join((network.kind, *map(str, network.hidden))) if network.kind == "mlp" else network.kind,
    }
    return "; ".join(f"{name}: {value}" for name, value in parts.items())


def stated(tables: Mapping[str, Any]) -> set[str]:
    """The dotted names of the settings in nested tables."""
    return {".".join(path) for path, _ in leaves(tables)}


def env_id_of(tables: Mapping[str, Any]) -> str | None:
    """The env.id of nested tables that are not checked yet; None if it is none."""
    env = tables.get("env")
    found = env.get("id") if isinstance(env, Mapping) else None
    return found if isinstance(found, str) else None
