"""A grid of runs: reads its TOML file, checks it, and expands it into cells before anything runs."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from msgspec import Meta

from coop.common.bounded import Counter
from coop.common.envs.make import env_spec
from coop.common.errors import CoopError, UsageError, closest, refusal
from coop.common.process.untrusted import MAX_SETTINGS, check_run_name, read_text
from coop.common.settings.config import RunConfig, check_distributed
from coop.common.settings.environment import EnvSettings
from coop.common.settings.fields import Positive
from coop.common.settings.methods import METHODS
from coop.common.settings.names import MethodName
from coop.common.settings.overrides import leaves, merged, nested, of_method
from coop.common.settings.reading import checked, parse_toml, with_numbers
from coop.common.settings.starting import env_id_of, starting_tables, stated
from coop.common.settings.tables import load_tables, resolve, shortened, to_tables, validated

FieldPath = tuple[str, ...]  # in nested tables: ("replay", "capacity")


@dataclass(frozen=True)
class GridFile:
    """The contents of a grid's file."""

    methods: Annotated[tuple[MethodName, ...], Meta(min_length=1)] = ("coop",)
    seeds: Annotated[tuple[Counter, ...], Meta(min_length=1)] = (0,)
    title: str = ""
    """The grid's question, in one line."""
    preset: str = ""
    """Preset from which every cell starts; that of its environment if empty, neutral settings if it has none."""
    mode: Literal["lockstep", "distributed"] = "lockstep"
    """Whether a cell is a run of coop-lockstep or of coop-local."""
    actors: Positive = 1
    """Number of actor processes in a distributed cell."""
    fixed: dict[str, Any] = field(default_factory=dict)
    """Config fields that all cells share."""
    vary: dict[str, Any] = field(default_factory=dict)
    """Config fields that vary, each with a list of values."""


@dataclass(frozen=True)
class Cell:
    """One run of a grid; `name`: of its folder."""

    name: str
    config: RunConfig


@dataclass(frozen=True)
class Choice:
    """What distinguishes a cell from the others; `values` of the fields that vary, `name` of its folder."""

    name: str
    method: str
    seed: int
    values: Mapping[FieldPath, Any]


@dataclass(frozen=True)
class Grid:
    """A grid: its file's contents, and its cells, ordered by seed first."""

    file: GridFile

    @cached_property
    def choices(self) -> tuple[Choice, ...]:
        """The cells by their names, their values not yet checked. Raises UsageError for axes that are no lists."""
        return tuple(_choices(self.file))

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The cells, checked. Raises UsageError."""
        return _cells(self.file, self.choices)

    @property
    def varied(self) -> tuple[str, ...]:
        """Dotted names of the fields that vary."""
        return tuple(".".join(path) for path, _ in leaves(self.file.vary))

    def to_toml(self) -> str:
        """The grid as a file for `load_grid`."""
        return tomli_w.dumps(asdict(self.file))


def shipped_grids() -> list[str]:
    """The grids that come with the package."""
    return sorted(entry.name.removesuffix(".toml") for entry in files("coop.studies").joinpath("grids").iterdir())


def load_grid(name: str, quick: bool = False) -> Grid:
    """Read, check and expand a grid.

    Args:
        name: of a grid that comes with the package, or the path of a TOML file.
        quick: use the small version from the file's table `quick`.

    Raises:
        UsageError: the grid is invalid; names the file, the field and what is allowed.
    """
    try:
        text = _text(name)
    except (OSError, UnicodeDecodeError, CoopError) as error:
        raise UsageError(f"grid {name}: {getattr(error, 'strerror', None) or error}") from error
    return parse_grid(text, name, quick)


def grid_text(tables: Mapping[str, Any]) -> str:
    """The TOML of a grid's contents; raises UsageError for what TOML can't say."""
    try:
        return tomli_w.dumps(tables)
    except (TypeError, ValueError, AttributeError, RecursionError) as error:  # also for a key that is no text
        raise UsageError(f"grid: {error}") from error


def parse_grid(text: str, name: str, quick: bool = False, check: bool = True) -> Grid:
    """Read and expand a grid's TOML; name: for error messages. Raises UsageError as `load_grid`.

    check: its cells too, which takes milliseconds each; without it only `choices` is known to be valid.
    """
    try:
        tables = parse_toml(text)
        small = tables.pop("quick", None)
        if quick:
            if not isinstance(small, dict):
                raise UsageError("--quick: it has no table [quick]")
            tables = merged(tables, small)
        grid = Grid(checked(GridFile, tables))
        _ = grid.cells if check else grid.choices
        return grid
    except UsageError as error:
        raise UsageError(f"grid {name}: {error}") from error


def _text(name: str) -> str:
    if name in shipped_grids():
        return files("coop.studies").joinpath("grids", f"{name}.toml").read_text(encoding="utf-8")
    if not name.endswith(".toml"):
        hint = f"give a .toml file or one of {', '.join(shipped_grids())}"
        raise UsageError(refusal("unknown", closest(name, shipped_grids()), hint))
    return read_text(Path(name), MAX_SETTINGS).removeprefix("\ufeff")  # a mark that some editors write


def _choices(file: GridFile) -> Iterator[Choice]:
    axes = _axes(file)
    names = dict(zip(axes, _short_names(tuple(axes)), strict=True))
    for seed, *values, method in itertools.product(file.seeds, *axes.values(), file.methods):
        chosen = dict(zip(axes, values, strict=True))
        if METHODS.get(method).stream is not None:
            if any(value != axes[path][0] for path, value in chosen.items() if path[0] == "replay"):
                continue  # it has no replay buffer: one cell for all settings of the others'
            chosen = {path: value for path, value in chosen.items() if path[0] != "replay"}
        parts = [f"{names[path]}={_word(value)}" for path, value in chosen.items()]
        name = check_run_name("-".join([method.replace(":", "."), *parts, f"seed={seed}"]), "a cell")
        yield Choice(name, method, seed, chosen)


def _cells(file: GridFile, choices: Iterable[Choice]) -> tuple[Cell, ...]:

    @cache
    def base(method: str, total_steps: int | None, env_id: str | None) -> dict[str, Any]:
        preset = starting(file, env_id)
        return to_tables(resolve(preset if total_steps is None else shortened(preset, total_steps), method))

    cells = []
    for choice in choices:
        given = file.fixed
        for path, value in choice.values.items():
            given = merged(given, nested(path, value))
        given = with_numbers(RunConfig, given)
        total_steps = given.get("total_steps")
        fits = type(total_steps) is int and total_steps > 0  # other values are refused below
        start = base(choice.method, total_steps if fits else None, env_id_of(given))
        tables = {**of_method(merged(start, given), choice.method), "seed": choice.seed}
        cells.append(Cell(choice.name, validated(tables, stated(given), lockstep=file.mode == "lockstep")))
    for cell in cells:
        check_distributed(cell.config) if file.mode == "distributed" else _check_lockstep(cell.config)
    _check_environments(cells)
    _check_collisions(cells)
    return tuple(cells)


def starting(file: GridFile, env_id: str | None = None) -> dict[str, Any]:
    """The tables from which the cells of an environment start, None for that of most grids."""
    return load_tables(file.preset, None) if file.preset else starting_tables(env_id)


def _axes(file: GridFile) -> dict[FieldPath, list[Any]]:
    """The varying fields with their values."""
    axes, fixed = dict(leaves(file.vary)), dict(leaves(file.fixed))
    for path, values in axes.items():
        if not isinstance(values, list) or not values:
            raise UsageError(f"vary.{'.'.join(path)} = {values!r}: must be a list of at least one value")
    for name in ("method", "seed"):
        if (name,) in axes.keys() | fixed.keys():
            raise UsageError(f"{name}: list it as `{name}s`, outside of [fixed] and [vary]")
    if twice := axes.keys() & fixed.keys():
        raise UsageError(f"{', '.join('.'.join(path) for path in sorted(twice))}: both in [fixed] and in [vary]")
    return axes


def _short_names(paths: tuple[FieldPath, ...]) -> list[str]:
    """The last word of each path, or the whole path if two share that word."""
    last = [path[-1] for path in paths]
    return [path[-1] if last.count(path[-1]) == 1 else ".".join(path) for path in paths]


def _word(value: Any) -> str:  # noqa: ANN401 (a value of any field)
    """Format a value for a folder's name."""
    text = ".".join(map(str, value)) if isinstance(value, list) else str(value)
    return re.sub(r"[^A-Za-z0-9.]+", "_", text)


def _check_environments(cells: list[Cell]) -> None:
    known: list[EnvSettings] = []
    for cell in cells:
        if cell.config.env not in known:
            env_spec(cell.config.env)  # refuses invalid environments
            known.append(cell.config.env)


def _check_lockstep(config: RunConfig) -> None:
    if config.actor.num_envs != 1:
        raise UsageError(f"actor.num_envs = {config.actor.num_envs}: lockstep cells play one emulator; fix it to 1")


def _check_collisions(cells: list[Cell]) -> None:
    by_name: dict[str, Cell] = {}
    by_config: dict[RunConfig, Cell] = {}
    for cell in cells:
        if cell.name in by_name:
            raise UsageError(f"two cells collide: both are called {cell.name}")
        if other := by_config.get(cell.config):
            raise UsageError(f"two cells collide: {other.name} and {cell.name} are the same run")
        by_name[cell.name] = by_config[cell.config] = cell
