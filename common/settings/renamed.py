"""Reads settings of earlier versions: their names, in tables and on command lines, and what they meant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from coop.common.errors import UsageError
from coop.common.process.notices import note_renamed
from coop.common.settings.config import LearnerSettings
from coop.common.settings.environment import EnvSettings

_RENAMED = {
    "replay": {"start": "learning_starts"},
    "learner": {"denominator": "eps", "swap_by": "swap_unit"},
}
# These chose between ways that have become one; files may still name them.
_GONE = {"learner": {"compile"}, "edl": {"polar_dtype"}}
# The meaning of these depended on the optimizer; a name that is not listed keeps its meaning.
_OF_OPTIMIZER = {
    "sgd": {"squared_decay": "alpha"},
    "rmsprop": {"squared_decay": "alpha"},
    "rmsprop-mnih": {"squared_decay": "alpha", "momentum": "gradient_alpha"},
    "adam": {"squared_decay": "beta2", "momentum": "beta1"},
}
_ONLY_NOW = {"eps", "alpha", "beta1", "beta2", "gradient_alpha"}  # with one of these, momentum is today's momentum
_VALUES = {"swap_unit": {"plays": "steps"}}


def current(tables: Mapping[str, Any], optimizer: str = LearnerSettings.optimizer) -> dict[str, Any]:
    """Rename the settings of nested tables to their present names; one line on stderr lists those renamed.

    optimizer: the one in use if the tables name none.

    Raises:
        UsageError: a setting is given under both names.
    """
    found: dict[str, str] = {}
    renamed = _sections(tables, optimizer, found)
    note_renamed(found)
    return renamed


def current_flags(args: Sequence[str], optimizer: str) -> list[str]:
    """Rename the flags of a command line to their present names; otherwise like `current`.

    optimizer: the one in use if the command line names none.
    """
    for token, following in zip(args, [*args[1:], ""], strict=False):
        flag, equals, value = token.partition("=")
        if flag == "--learner.optimizer":
            optimizer = value if equals else following
    found: dict[str, str] = {}
    renamed = list(_flags(args, optimizer, found))
    note_renamed(found)
    return renamed


def with_stack(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Give a resolved config from before `env.grayscale` the stack that its run had.

    Such a config states `env.stack` in any case, but vectors were never stacked; of the environments that those
    versions accepted beside ALE's games, only Catch has pictures.
    """
    env = tables.get("env")
    if not isinstance(env, Mapping) or "grayscale" in env or not {"id", "noop_max", "stack"} <= env.keys():
        return dict(tables)
    unstacked = not EnvSettings(id=str(env["id"])).atari and env["id"] != "coop/Catch-v0"
    return {**tables, "env": {**env, "stack": 1}} if unstacked else dict(tables)


def _flags(args: Sequence[str], optimizer: str, found: dict[str, str]) -> Iterator[str]:
    values: Mapping[str, str] = {}  # present values of the flag before, by former ones
    for token in args:
        flag, equals, value = token.partition("=")
        section, _, former = flag.removeprefix("--").replace("-", "_").partition(".")
        name = _names(section, optimizer).get(former) if flag.startswith("--") else None
        if name is None:
            yield values.get(token, token)
            values = {}
            continue
        found[flag] = f"--{section}.{name.replace('_', '-')}"
        values = _VALUES.get(name, {})
        yield f"{found[flag]}{equals}{values.get(value, value)}"


def _sections(tables: Mapping[str, Any], optimizer: str, found: dict[str, str]) -> dict[str, Any]:
    learner = tables.get("learner")
    if isinstance(learner, Mapping):
        optimizer = str(learner.get("optimizer", optimizer))
    renamed = dict(tables)
    for section in _RENAMED | _GONE:
        if isinstance(table := tables.get(section), Mapping):
            renamed[section] = _section(section, table, optimizer, found)
    if isinstance(methods := tables.get("methods"), Mapping):
        renamed["methods"] = {
            method: _sections(over, optimizer, found) if isinstance(over, Mapping) else over
            for method, over in methods.items()
        }
    return renamed


def _section(section: str, table: Mapping[str, Any], optimizer: str, found: dict[str, str]) -> dict[str, Any]:
    names = _names(section, optimizer)
    if _ONLY_NOW & table.keys():
        names.pop("momentum", None)
    renamed: dict[str, Any] = {}
    for former, value in table.items():
        if former in _GONE.get(section, ()):
            continue
        name = names.get(former, former)
        if name != former and name in table:
            raise UsageError(f"{section}.{former} and {section}.{name}: two names of one setting; give the second")
        if name == "beta1" and former == "momentum" and value == 0:
            continue  # stood for Adam's own 0.9, the default of beta1
        if name != former:
            found[f"{section}.{former}"] = f"{section}.{name}"
        renamed[name] = _VALUES.get(name, {}).get(value, value) if isinstance(value, str) else value
    return renamed


def _names(section: str, optimizer: str) -> dict[str, str]:
    """Present names of a section's settings, by former ones."""
    of_optimizer = _OF_OPTIMIZER.get(optimizer, {}) if section == "learner" else {}
    return {**_RENAMED.get(section, {}), **of_optimizer}
