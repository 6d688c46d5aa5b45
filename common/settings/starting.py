"""What a run starts from: a preset, that of its environment, or neutral settings; and its settings in a line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


def settings_line(*runs: tuple[RunConfig, str]) -> str:
    """The settings that matter most, in one line: "varying" where runs differ.

    runs: each run's config and where that comes from, see `source_of`.
    """

    def of(texts: Sequence[str]) -> str:
        return texts[0] if len(set(texts)) == 1 else "varying"

    configs = [config for config, _ in runs]
    tables = [config.replay for config in configs if not config.streaming]
    of_tables = {
        "capacity": [f"{table.capacity:,}" for table in tables],
        "eviction": [table.eviction for table in tables],
        "sampling": [table.sampling for table in tables],
        "ratio": [f"{table.ratio:g}" for table in tables],
    }
    parts = {
        "settings": of([source for _, source in runs]),
        "method": of([config.method for config in configs]),
        "gamma": of([f"{config.learner.gamma:g}" for config in configs]),
        "replay": ", ".join(f"{name} {of(texts)}" for name, texts in of_tables.items()) if tables else "no buffer",
        "network": of([_layers(config) for config in configs]),
    }
    return "; ".join(f"{name}: {value}" for name, value in parts.items())


def _layers(config: RunConfig) -> str:
    kind, hidden = config.network.kind, config.network.hidden
    return "-".join((kind, *map(str, hidden))) if kind == "mlp" else kind


def stated(tables: Mapping[str, Any]) -> set[str]:
    """The dotted names of the settings in nested tables."""
    return {".".join(path) for path, _ in leaves(tables)}


def env_id_of(tables: Mapping[str, Any]) -> str | None:
    """The env.id of nested tables that are not checked yet; None if it is none."""
    env = tables.get("env")
    found = env.get("id") if isinstance(env, Mapping) else None
    return found if isinstance(found, str) else None
