"""The flags of a command: what tyro makes of a dataclass's fields, for the help, for suggestions and for shells."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import tyro
from tyro import _arguments as tyro_arguments  # private, as the two below; pyproject.toml pins the version
from tyro import _parsers as tyro_parsers
from tyro import _strings as tyro_strings
from tyro._backends import _tyro_backend as tyro_backend

SHELLS = ("bash", "zsh", "fish")

HttpAddress = Annotated[str, tyro.conf.arg(metavar="[HOST:]PORT")]
"""Where to serve HTTP; see `coop.common.process.ports.http_address`."""


@dataclass(frozen=True)
class Flag:
    """A flag or a positional argument.

    name: "--learner.swap-every"; of a positional argument its placeholder, "RUN_DIR".
    value: placeholder of the value, "INT"; empty for a switch, which `negative` ("--learner.no-double") turns off.
    choices: the allowed values, where they are names. text: what it sets. default: empty if there is none, or of
    a switch that is off.
    """

    name: str
    value: str
    choices: tuple[str, ...]
    text: str
    default: str
    required: bool
    negative: str = ""


@dataclass(frozen=True)
class Section:
    """The flags of one dataclass; name and text are empty for those of the command itself."""

    name: str
    text: str
    flags: tuple[Flag, ...]


def sections(kind: type[Any], default: object = None) -> list[Section]:
    """The flags of a dataclass, positional arguments first, then of each one nested in it.

    default: an instance with the values to show.
    """
    with tyro_strings.delimiter_context("-"):
        return list(_sections(_specification(kind, default)))


def completion(kind: type[Any], default: object, program: str, shell: str) -> str:
    """A script that completes a command's flags and their values in one of `SHELLS`."""
    with tyro_strings.delimiter_context("-"):
        specification = _specification(kind, default)
        for each in specification.get_args_including_children():
            lowered = each.arg.lowered
            lowered.choices, lowered.metavar = _choices(each.arg) or None, placeholder(each.arg)
        backend = tyro_backend.TyroBackend()
        prefix = f"tyro_{program.replace('-', '_')}"
        return backend.generate_completion(specification, program, shell, prefix)  # type: ignore[arg-type]


def _specification(kind: type[Any], default: object) -> tyro_parsers.ParserSpecification:
    return tyro_parsers.ParserSpecification.from_callable_or_type(
        kind,
        markers=set(),
        description=None,
        parent_classes=set(),
        default_instance=tyro.MISSING_NONPROP if default is None else default,
        intern_prefix="",
        extern_prefix="",
        subcommand_prefix="",
        support_single_arg_types=False,
        prog_suffix="",
    )


def _sections(parser: tyro_parsers.ParserSpecification, name: str = "", text: str = "") -> Iterator[Section]:
    flags = [_flag(arg) for arg in parser.args if not arg.is_suppressed()]
    yield Section(name, text, tuple(sorted(flags, key=lambda flag: flag.name.startswith("-"))))
    for prefix, nested in parser.child_from_prefix.items():
        yield from _sections(nested, prefix, nested.description)


def _flag(arg: tyro_arguments.ArgumentDefinition) -> Flag:
    lowered, given = arg.lowered, arg.field.helptext
    text = (given() if callable(given) else given) or ""
    name = placeholder(arg) if arg.is_positional() else lowered.name_or_flags[-1]
    if lowered.action == "boolean_optional_action":
        default = "on" if arg.field.default else ""
        return Flag(name, "", (), text, default, False, tyro_arguments.flag_to_inverse(name) or "")
    return Flag(name, placeholder(arg), _choices(arg), text, _shown(arg), bool(lowered.required))


def placeholder(arg: tyro_arguments.ArgumentDefinition) -> str:
    """What stands for the value in the help: "INT", "INT ..." for several, "{fifo,reservoir}" for one of several."""
    metavar = (arg.lowered.metavar or "").removeprefix("{None}|")
    short = re.sub(r"\[(\w+|\{[^ {}]+\}) \[\1 \.\.\.\]\]", r"\1 ...", metavar)
    return short.strip("{}") if short == metavar and not _choices(arg) else short


def _choices(arg: tyro_arguments.ArgumentDefinition) -> tuple[str, ...]:
    """The names in a placeholder such as "{fifo,reservoir}"."""
    found = re.fullmatch(r"\{([^ {}]+)\}", (arg.lowered.metavar or "").removeprefix("{None}|"))
    return tuple(found[1].split(",")) if found else ()


def _shown(arg: tyro_arguments.ArgumentDefinition) -> str:
    """The default as the command line would have it."""
    default, write = arg.field.default, arg.lowered.str_from_instance
    if default is None or arg.lowered.required or write is None:
        return ""
    words = write(default)
    return words if isinstance(words, str) else " ".join(words)
