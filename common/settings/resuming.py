"""Which settings may change when a run is resumed."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

from coop.common.errors import RunError, UsageError
from coop.common.settings.config import OF_MACHINE, OUTSIDE, RunConfig
from coop.common.settings.overrides import leaves
from coop.common.settings.tables import to_tables

_FREE = (*OUTSIDE, "target_return")
_TELLS_APART = (("run",), ("method",), ("seed",), ("env", "id"))
_LIMITS = ("total_updates", "total_episodes")  # 0: none
_GROWING = ("total_steps", *_LIMITS)


def settings_digest(config: RunConfig) -> str:
    """A checksum of the settings that stay the same in a resumed run, for its checkpoints."""
    values = leaves(to_tables(config))
    kept = [(path, value) for path, value in values if not (_is_free(path) or path[0] in ("methods", *_GROWING))]
    return f"{zlib.crc32(repr(sorted(kept, key=str)).encode()):08x}"


def _is_free(path: tuple[str, ...]) -> bool:
    """Whether a setting may take any value in a resumed run."""
    return path[0] in _FREE or (path[0] == "learner" and path[1] in OF_MACHINE)


def check_resumed(config: RunConfig, saved: RunConfig, source: Path) -> None:
    """Refuse changes that would make it a different run.

    A run may be made longer: `total_steps`, `total_updates` and `total_episodes` may grow, and `target_return` and
    what training does not depend on may take any value, as may the learner's device and threads. Schedules that span
    the run (`learner.learning_rate_final`) then follow the longer run.

    Args:
        config: the config that the command line asks for. saved: the run's config so far. source: the file of `saved`.

    Raises:
        RunError: the run has another name, method, seed or environment.
        UsageError: another field that must not change has changed; names each such field with both values.
    """
    here, there = (dict(leaves(to_tables(each))) for each in (config, saved))
    for path in _TELLS_APART:
        if here[path] != there[path]:
            name, folder = ".".join(path), source.parent
            raise RunError(
                f"run directory {folder}: another run's, whose {name} is {there[path]}; here it is {here[path]}"
            )
    refused = [
        f"{'.'.join(path)} = {here.get(path)}, but {there.get(path)}{_allowed(path)}"
        for path in {**here, **there}
        if path[0] != "methods" and not _may_change(path, here.get(path), there.get(path))
    ]
    if refused:
        raise UsageError(f"--resume: {'; '.join(refused)} in {source}, which goes on")


def _may_change(path: tuple[str, ...], here: Any, there: Any) -> bool:  # noqa: ANN401 (values of any field)
    if here == there or _is_free(path):
        return True
    if path == ("total_steps",):
        return bool(here > there)
    return path[0] in _LIMITS and (here == 0 or 0 < there < here)


def _allowed(path: tuple[str, ...]) -> str:
    return " (it may only grow)" if path[0] in _GROWING else ""
