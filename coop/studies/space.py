"""The settings among which a search chooses, and whether a study that was begun chooses among the same ones."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coop.common.errors import CoopError, UsageError
from coop.common.places import absolute
from coop.common.process.untrusted import MAX_SETTINGS, read_text
from coop.common.settings.overrides import merged, nested
from coop.common.settings.reading import checked, parse_toml
from coop.common.settings.tables import first_difference
from coop.studies.sweep.grid import Cell, Grid, GridFile, grid_text

if TYPE_CHECKING:
    import optuna

RANGE = {"low", "high", "log", "step"}
GRID = "grid"  # attribute of a study: the grid of its first call


class Space:
    """The settings among which a search chooses."""

    def __init__(self, grid: str | Path | Mapping[str, Any]) -> None:
        """Read a grid; raises UsageError, also for settings that no run takes."""
        if isinstance(grid, Mapping):
            grid_text(grid)  # refuses what a file can't say, which a storage can't either
        else:
            path = absolute(grid, "grid")
        try:
            tables = dict(grid) if isinstance(grid, Mapping) else parse_toml(read_text(path, MAX_SETTINGS))
            tables.pop("quick", None)
            self.file = checked(GridFile, tables)
        except (OSError, UnicodeDecodeError, CoopError) as error:
            name = "grid" if isinstance(grid, Mapping) else f"grid {grid}"
            raise UsageError(f"{name}: {getattr(error, 'strerror', None) or error}") from error
        self.axes = _axes(self.file.vary)
        first = {name: each["low"] if isinstance(each, Mapping) else each[0] for name, each in self.axes.items()}
        self.cells("trial", self.file.methods[0], first)

    def cells(self, name: str, method: str, chosen: Mapping[str, Any]) -> list[Cell]:
        """A cell for each seed with the chosen settings, by their dotted names; raises UsageError."""
        fixed = self.file.fixed
        for field_name, value in chosen.items():
            fixed = merged(fixed, nested(tuple(field_name.split(".")), value))
        cells = Grid(replace(self.file, methods=(method,), fixed=fixed, vary={})).cells
        each = [f"{name}-seed={cell.config.seed}" if len(cells) > 1 else name for cell in cells]
        return [Cell(own, cell.config) for own, cell in zip(each, cells, strict=True)]

    def suggest(self, trial: optuna.trial.BaseTrial) -> tuple[str, dict[str, Any]]:
        """(method, settings) of a trial."""
        methods = list(self.file.methods)
        method = trial.suggest_categorical("method", methods) if len(methods) > 1 else methods[0]
        return str(method), {name: _suggested(trial, name, values) for name, values in self.axes.items()}

    def check(self, study: optuna.Study) -> None:
        """Note the grid in a new study; raise UsageError for one that was begun with what can't be compared with it.

        Ranges may change, and fields may be added to those that vary.
        """
        from optuna.distributions import check_distribution_compatibility  # noqa: PLC0415 (an extra)
        from optuna.trial import FixedTrial  # noqa: PLC0415

        tables = {name: value for name, value in asdict(self.file).items() if name not in ("title", "vary")}
        mine = json.loads(json.dumps(tables))
        if found := first_difference(mine, study.user_attrs.get(GRID, mine)):
            name, here, there = found
            raise UsageError(f"{name} = {here!r}: the search {study.study_name!r} has {there!r}; give another folder")
        each = {
            name: axis["low"] if isinstance(axis, Mapping) else _stored(axis)[0] for name, axis in self.axes.items()
        }
        self.suggest(trial := FixedTrial({"method": self.file.methods[0], **each}))
        for begun in study.get_trials(False):
            for name, now in trial.distributions.items():
                try:
                    check_distribution_compatibility(begun.distributions.get(name, now), now)
                except ValueError:
                    there, field = begun.distributions[name], "methods" if name == "method" else f"vary.{name}"
                    raise UsageError(
                        f"{field}: {now}; trial {begun.number} of the search {study.study_name!r} had {there}; "
                        "give another folder"
                    ) from None
        study.set_user_attr(GRID, mine)


def _axes(vary: Mapping[str, Any], at: str = "") -> dict[str, Any]:
    """The varying fields by dotted names: a list, or the table of a range. Raises UsageError."""
    found: dict[str, Any] = {}
    for key, value in vary.items():
        name = f"{at}{key}"
        if isinstance(value, Mapping) and "low" in value:
            low, high = value["low"], value.get("high")
            kinds = all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high))
            log_and_step = value.get("log") and "step" in value
            if value.keys() - RANGE or not kinds or low > high or log_and_step or (value.get("log") and low <= 0):
                raise UsageError(f"vary.{name} = {dict(value)!r}: must be low and high, with log = true or a step")
            found[name] = value
        elif isinstance(value, Mapping):
            found |= _axes(value, f"{name}.")
        elif isinstance(value, list | tuple) and value:
            found[name] = list(value)
        else:
            raise UsageError(f"vary.{name} = {value!r}: must be a list of at least one value, or low and high")
    return found


def _suggested(trial: optuna.trial.BaseTrial, name: str, values: Any) -> Any:  # noqa: ANN401 (of any field)
    if isinstance(values, Mapping):
        low, high, log, step = values["low"], values["high"], bool(values.get("log")), values.get("step")
        if isinstance(low, int) and isinstance(high, int):
            return trial.suggest_int(name, low, high, log=log, step=step or 1)
        return trial.suggest_float(name, low, high, log=log, step=step)
    chosen = trial.suggest_categorical(name, stored := _stored(values))
    return chosen if stored is values else json.loads(str(chosen))


def _stored(values: list[Any]) -> list[Any]:
    """A field's values as Optuna stores them: those that it does not as texts."""
    plain = all(isinstance(value, str | bool | int | float) for value in values)
    return values if plain else [json.dumps(value) for value in values]
