"""Converts a run's config from tables (presets, TOML files) and back, with all checks."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping
from dataclasses import asdict, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import tomli_w

from coop.common.errors import CoopError, UsageError, not_among
from coop.common.process.untrusted import MAX_SETTINGS, read_text
from coop.common.settings.config import OF_MACHINE, OUTSIDE, LearnerSettings, ReplaySettings, RunConfig
from coop.common.settings.methods import METHODS
from coop.common.settings.overrides import merged, of_method
from coop.common.settings.reading import checked, fields_of, parse_toml, with_numbers
from coop.common.settings.rules import check_rules, fitted

CONFIG = "config.toml"
SEAL = "# crc32 "


def preset_names() -> list[str]:
    """The presets that come with the package."""
    entries = files("coop.common.settings").joinpath("presets").iterdir()
    return sorted(entry.name.removesuffix(".toml") for entry in entries if entry.is_file())


def load_tables(preset: str | None, path: Path | None) -> dict[str, Any]:
    """Read a preset or a config file as nested tables.

    Raises:
        UsageError: an unknown preset, or a file that is missing or not TOML.
    """
    if path is not None:
        try:
            return parse_toml(read_text(path, MAX_SETTINGS).removeprefix("\ufeff"))  # a mark that some editors write
        except (OSError, UnicodeDecodeError, CoopError) as error:
            raise UsageError(f"--config {path}: {error}") from error
    if preset not in preset_names():
        raise UsageError(f"preset = {preset!r}: {not_among(preset_names(), str(preset))}")
    return _preset(f"{preset}.toml")


def base_tables(name: str) -> dict[str, Any]:
    """The settings that several presets share, as nested tables."""
    return _preset("bases", f"{name}.toml")


def _preset(*place: str) -> dict[str, Any]:
    """Read a file under presets/, merged over the one in presets/bases/ that it extends."""
    tables = parse_toml(files("coop.common.settings").joinpath("presets", *place).read_text(encoding="utf-8"))
    base = tables.pop("extends", None)
    return tables if base is None else merged(base_tables(base), tables)


def shortened(tables: Mapping[str, Any], total_steps: int) -> dict[str, Any]:
    """Fit a preset to a run of another length.

    `replay.learning_starts` becomes at most a tenth of the run, so that learning begins. In a shorter run the learning
    rate follows the preset's own schedule: it ends at the share that the full run would have reached by then.
    """
    replay, learner = tables.get("replay", {}), tables.get("learner", {})
    start = min(replay.get("learning_starts", ReplaySettings.learning_starts), max(1, total_steps // 10))
    full = tables.get("total_steps", RunConfig.total_steps)
    part = min(max(total_steps, 0), full) / full  # one that is out of range is refused later
    final = learner.get("learning_rate_final", LearnerSettings.learning_rate_final) ** part
    return {
        **tables,
        "total_steps": total_steps,
        "replay": {**replay, "learning_starts": start},
        "learner": {**learner, "learning_rate_final": final},
    }


def resolve(tables: Mapping[str, Any], method: str | None = None) -> RunConfig:
    """Turn tables into a checked config; a `[methods.NAME]` table overrides the rest for that method.

    Two defaults follow from other fields: epsilon falls over a tenth of the run, and learning starts with 500
    transitions, or with fewer where the table holds fewer or a tenth of the run is shorter; at once behind a data set.

    Raises:
        UsageError: an unknown field or a value out of range; names the field, the value and what is allowed.
    """
    return validated(_completed(with_numbers(RunConfig, of_method(tables, method))))


def _completed(tables: dict[str, Any]) -> dict[str, Any]:
    """The tables with the defaults that follow from other fields; what is no number is refused later."""
    replay, actor = tables.get("replay", {}), tables.get("actor", {})
    steps = tables.get("total_steps", RunConfig.total_steps)
    if not isinstance(replay, Mapping) or not isinstance(actor, Mapping) or not isinstance(steps, int):
        return tables
    tenth, capacity = max(1, steps // 10), replay.get("capacity", ReplaySettings.capacity)
    if "learning_starts" not in replay and isinstance(capacity, int):
        least = replay.get("n_step", ReplaySettings.n_step)
        start = 1 if replay.get("preload") else min(ReplaySettings.learning_starts, capacity, tenth)
        replay = {**replay, "learning_starts": max(start, least) if isinstance(least, int) else start}
    return {**tables, "replay": replay, "actor": {"epsilon_steps": tenth, **actor}}


def validated(
    tables: Mapping[str, Any] | RunConfig, given: Collection[str] | None = None, *, lockstep: bool = False
) -> RunConfig:
    """Check every field and the rules between fields.

    given, lockstep: see `fitted`; None: all settings have been asked for.

    Raises:
        UsageError: as `resolve`.
    """
    tables = to_tables(tables) if isinstance(tables, RunConfig) else dict(tables)
    settings = _settings_of_method(tables)
    config = replace(checked(RunConfig, tables), method_settings=settings)
    config = config if given is None else fitted(config, given, lockstep=lockstep)
    check_rules(config)
    return config


def _settings_of_method(tables: dict[str, Any]) -> Any:  # noqa: ANN401 (an instance of `Method.settings`)
    """Take a method's own settings out of its tables; None if it has none."""
    name = tables.get("method", RunConfig.method)
    known = isinstance(name, str) and METHODS.knows(name)  # another one is refused with the other fields
    method = METHODS.get(name) if known else None
    if method is None or method.settings is None:
        return None
    if method.table in fields_of(RunConfig):
        raise UsageError(f"method = {name!r}: its settings can't be called {method.table!r}, as others are")
    return checked(method.settings, tables.pop(method.table, {}), f"{method.table}.")


def to_toml(config: RunConfig) -> str:
    """The resolved config as TOML, which `--config` reads."""
    return tomli_w.dumps(to_tables(config))


def run_config_text(config: RunConfig) -> str:
    """The text of a run's config.toml: the resolved config, and its checksum."""
    return sealed_toml(to_toml(config))


def sealed_toml(text: str) -> str:
    """The text of a TOML file, with its checksum as a comment."""
    return f"{text}{SEAL}{zlib.crc32(text.encode()):08x}\n"


def check_toml(text: str, place: object, *, needed: bool = False) -> None:
    """Check a text of `sealed_toml`; needed: it must have a checksum. Raises UsageError."""
    content, seal, _ = text.rpartition(SEAL)
    if (seal or needed) and text != sealed_toml(content):
        raise UsageError(f"{place}: not what was written (wrong checksum)")


def parse_run_config(text: str, place: object, *, needed: bool = False) -> RunConfig:
    """Read the text of a run's config.toml; place: for the error. needed: it must have a checksum.

    Raises UsageError.
    """
    check_toml(text, place, needed=needed)
    try:
        tables = parse_toml(text)
    except UsageError as error:
        raise UsageError(f"{place}: {error}") from error
    return resolve(tables)


def to_tables(config: RunConfig) -> dict[str, Any]:
    """The resolved config as plain nested tables, for the wire."""
    tables = asdict(config)
    settings = tables.pop("method_settings")
    return _without_none(tables if settings is None else {**tables, METHODS.get(config.method).table: settings})


def identity(config: RunConfig) -> dict[str, Any]:
    """The settings, as nested tables, that all processes of a run must share.

    These are all but those that training does not depend on, those of the learner's machine, and the settings of other
    methods.
    """
    tables = {name: value for name, value in to_tables(config).items() if name not in (*OUTSIDE, "methods")}
    learner = {name: value for name, value in tables["learner"].items() if name not in OF_MACHINE}
    return {**tables, "learner": learner}


def first_difference(here: Mapping[str, Any], there: Mapping[str, Any], name: str = "") -> tuple[str, Any, Any] | None:
    """(name, here, there) of the first field in which nested tables differ; None if they are equal."""
    for key in {**here, **there}:
        mine, theirs = here.get(key), there.get(key)
        if isinstance(mine, Mapping) and isinstance(theirs, Mapping):
            if found := first_difference(mine, theirs, f"{name}{key}."):
                return found
        elif mine != theirs:
            return f"{name}{key}", mine, theirs
    return None


def _without_none(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out fields that are None, for TOML has no null; they are read back as their defaults."""
    return {
        key: _without_none(value) if isinstance(value, Mapping) else value
        for key, value in tables.items()
        if value is not None
    }
