"""The references of settings, commands and metrics, as Markdown, from the code that defines them."""

from __future__ import annotations

import html
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

import coop
from coop.actors.cli import ActorOptions
from coop.common.bounds import MAX_INTEGER
from coop.common.metrics import METRICS
from coop.common.process.flags import Flag, sections
from coop.common.settings.config import RunConfig
from coop.common.settings.methods import METHODS, table_of
from coop.common.settings.tables import load_tables, preset_names, resolve
from coop.deploy.local import LocalOptions
from coop.deploy.router import RouterOptions
from coop.evaluation.cli import EvalOptions
from coop.evaluation.export_cli import ExportOptions
from coop.learner.cli import LearnerOptions
from coop.lockstep.reexecute_cli import ReexecuteOptions
from coop.records.run_options import RunOptions, with_methods
from coop.replay.cli import ReplayOptions
from coop.replay.limits_cli import LimitsOptions
from coop.studies.report.cli import ReportOptions
from coop.studies.sweep.cli import SweepOptions
from coop.studies.watch.cli import WatchOptions

COMMANDS: dict[str, type[Any]] = {
    "coop-local": LocalOptions,
    "coop-learner": LearnerOptions,
    "coop-replay": ReplayOptions,
    "coop-limits": LimitsOptions,
    "coop-actor": ActorOptions,
    "coop-router": RouterOptions,
    "coop-lockstep": RunOptions,
    "coop-reexecute": ReexecuteOptions,
    "coop-sweep": SweepOptions,
    "coop-eval": EvalOptions,
    "coop-export": ExportOptions,
    "coop-watch": WatchOptions,
    "coop-report": ReportOptions,
}


def settings_reference() -> str:
    """A table for each section of a run's settings: field, allowed values, default and meaning."""
    schemas = _schemas()
    parts = []
    for part in filter(lambda part: part.flags, sections(with_methods(RunOptions))):
        section = part.name.replace("-", "_")
        known = {field_name(flag): flag for flag in part.flags if _last(field_name(flag)) in schemas[section]}
        rows = [
            (f"`{name}`", _allowed(flag, schemas[section][_last(name)]), _default(flag, "`true`", "`false`"), flag.text)
            for name, flag in known.items()
        ]
        title = f"### `[{section}]`\n\n{part.text}" if section else "### The run"
        parts.append(f"{title}\n\n" + _table(("field", "allowed", "default", "meaning"), rows))
    return "\n".join(parts)


def presets_reference() -> str:
    """A table of the presets: what they play, their steps, and the size of their buffer."""
    configs = {name: resolve(load_tables(name, None)) for name in preset_names()}
    rows = [
        (f"`{name}`", f"`{config.env.id}`", f"{config.total_steps:,}", f"{config.replay.capacity:,}")
        for name, config in configs.items()
    ]
    return _table(("preset", "environment", "steps", "buffer"), rows)


def commands_reference() -> str:
    """A table for each command: flag, default and meaning. The settings of a run are in the reference of settings."""
    settings = {flag.name for part in sections(RunConfig) for flag in part.flags}
    parts = []
    for command, kind in COMMANDS.items():
        run = issubclass(kind, RunOptions)
        flags = [flag for part in sections(kind) for flag in part.flags if not (run and flag.name in settings)]
        also = "Every setting of a run is a flag as well: [configuration](configuration.md).\n\n" if run else ""
        rows = [(_form(flag), _default(flag), flag.text) for flag in flags]
        parts.append(f"### `{command}`\n\n{also}" + _table(("flag", "default", "meaning"), rows))
    return "\n".join(parts)


def metrics_reference() -> str:
    """A table of the metrics: what each is, its unit, and its name wherever it is shown."""
    head = ("metric", "what it is", "unit", "`metrics.jsonl`", "JSON", "Prometheus", "TensorBoard", "screen", "page")
    rows = []
    for each in METRICS:
        names = (each.column, each.field, each.prometheus, each.tensorboard, each.line)
        code = [f"`{name}`" if name else "" for name in names]
        rows.append((f"`{each.name}`", each.meaning, each.unit, *code, each.chart))
    return _table(head, rows)


def names_reference() -> str:
    """A table of what `import coop` gives, with the first sentence of its text."""
    rows = []
    for name in coop.__all__:
        first, _, _ = (getattr(coop, name).__doc__ or "").strip().partition("\n\n")
        rows.append((f"`coop.{name}`", " ".join(first.split())))
    return _table(("name", "what it is"), rows)


def field_name(flag: Flag) -> str:
    """The field of a flag, as a TOML file has it: "learner.swap_every"."""
    return flag.name.removeprefix("--").replace("-", "_")


def _last(name: str) -> str:
    return name.rpartition(".")[2]


def _schemas() -> dict[str, Mapping[str, Any]]:
    """JSON schemas of the settings' fields, by section and field; those of the run itself are in section ""."""
    whole = msgspec.json.schema(RunConfig)["$defs"]
    found: dict[str, Mapping[str, Any]] = {"": {}}
    for name, schema in whole["RunConfig"]["properties"].items():
        if "$ref" in schema:
            found[name] = whole[schema["$ref"].rpartition("/")[2]]["properties"]
        elif name not in ("method_settings", "methods"):
            found[""] = {**found[""], name: schema}
    for method in map(METHODS.get, METHODS.names()):
        if (kind := method.settings) is not None:
            found[table_of(method.name)] = msgspec.json.schema(kind)["$defs"][kind.__name__]["properties"]
    return found


def _allowed(flag: Flag, schema: Mapping[str, Any]) -> str:
    if flag.choices:
        return ", ".join(f"`{choice}`" for choice in flag.choices)
    options = [option for option in schema.get("anyOf", [schema]) if option.get("type") != "null"]
    return " or ".join(map(_kind, options))


def _kind(schema: Mapping[str, Any]) -> str:
    """What a JSON schema allows, in a few words."""
    match schema["type"]:
        case "boolean":
            return "`true`, `false`"
        case "array":
            items = schema.get("items") or schema["prefixItems"][0]
            count = f"{schema['minItems']} of: " if schema.get("minItems") else "list of: "
            return count + _kind(items)
        case "object":
            return "table"
        case "string":
            return "text"
        case kind:
            return " ".join([kind, *_bounds(schema)])


def _bounds(schema: Mapping[str, Any]) -> Iterator[str]:
    words = {"exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "to"}
    for key, word in words.items():
        bound = schema.get(key, MAX_INTEGER)
        if abs(bound) not in (MAX_INTEGER, sys.float_info.max):  # which only says that a message can hold it
            yield f"{word} {bound:,}" if isinstance(bound, int) else f"{word} {bound:g}"


def _form(flag: Flag) -> str:
    """A flag as the help shows it, with the placeholder of its value."""
    value = "NAME" if len(flag.choices) > 4 else "" if flag.value == flag.name else flag.value
    names = [f"`{flag.name} {value}`".replace(" `", "`"), *([f"`{flag.negative}`"] if flag.negative else [])]
    return ", ".join(names)


def _default(flag: Flag, on: str = "on", off: str = "off") -> str:
    if flag.required:
        return "required"
    if flag.negative:
        return on if flag.default else off
    return f"`{flag.default}`" if flag.default else "-"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(_cell(cell) for cell in line) + " |\n" for line in lines)


def _cell(text: str) -> str:
    """Text for a cell of a table, on one line; what Markdown would read as HTML or as a border is escaped."""
    text = " ".join(text.split())
    safe = text if text.startswith("`") else html.escape(text, quote=False)
    return safe.replace("|", "\\|")
