"""The flags of a dataclass, as the help and the errors of a command line tell of them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import tyro
from docstring_parser import parse_from_object
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from coop.common.numbers import whole_number
from coop.common.places import user_path

HttpAddress = Annotated[str, tyro.conf.arg(metavar="[HOST:]PORT")]
"""Where to serve HTTP; see `coop.common.process.ports.http_address`."""

READERS = ConstructorRegistry()
"""How paths and whole numbers are read; tyro has the rules of other types."""


@READERS.primitive_rule
def _path(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Path] | None:
    """Reads every flag that is a path as `user_path` does."""
    if info.type is not Path:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: user_path(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda value: [str(value)],
    )


@READERS.primitive_rule
def _int(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    """Reads every flag that is a whole number as `whole_number` does."""
    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: whole_number(words[0]),
        is_instance=lambda value: isinstance(value, int) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


@dataclass(frozen=True)
class Flag:
    """A flag or a positional argument.

    name: "--learner.swap-every"; of a positional argument its placeholder, "RUN_DIR".
    value: placeholder of the value: "INT", "INT ..." for several, "{fifo,reservoir}" for one of several; empty for a
    switch, which `negative` ("--learner.no-double") turns off. choices: the allowed values, where they are names.
    text: what it sets. default: empty if there is none, or of a switch that is off. reader: of a flag with a value.
    """

    name: str
    value: str
    choices: tuple[str, ...]
    text: str
    default: str
    required: bool
    negative: str = ""
    reader: PrimitiveConstructorSpec[Any] | None = None


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
    with READERS:
        return list(_sections(kind, default))


def _sections(kind: type[Any], given: object, prefix: str = "") -> Iterator[Section]:
    hints, texts = get_type_hints(kind, include_extras=True), _texts(kind)
    flags: list[Flag] = []
    nested: list[Section] = []
    for field in fields(kind):
        hint = hints[field.name]
        default = _default(field) if given is None else getattr(given, field.name)
        name = prefix + field.name.replace("_", "-")
        if is_dataclass(hint):
            nested += _sections(hint, default, f"{name}.")  # type: ignore[arg-type] # a class
        elif tyro.conf.Suppress not in getattr(hint, "__metadata__", ()):
            flags.append(_flag(name, hint, texts.get(field.name, ""), default))
    text = inspect.cleandoc(kind.__doc__ or "") if prefix else ""
    yield Section(prefix.rstrip("."), text, tuple(sorted(flags, key=lambda flag: flag.name.startswith("-"))))
    yield from nested


def _texts(kind: type[Any]) -> dict[str, str]:
    """The docstrings of a dataclass's fields, inherited ones included."""
    found = {}
    for each in filter(is_dataclass, reversed(kind.__mro__)):
        found.update(_own_texts(each))
    return found


@cache
def _own_texts(kind: type[Any]) -> dict[str, str]:
    return {each.arg_name: inspect.cleandoc(each.description or "") for each in parse_from_object(kind).params}


def _default(field: Field[Any]) -> object:
    return field.default if field.default_factory is MISSING else field.default_factory()


def _flag(name: str, hint: object, text: str, default: object) -> Flag:
    extras = getattr(hint, "__metadata__", ())
    text = next((each.help for each in extras if getattr(each, "help", None)), text)
    if (get_args(hint)[0] if get_origin(hint) is Annotated else hint) is bool:
        section, dot, last = name.rpartition(".")
        return Flag(f"--{name}", "", (), text, "on" if default else "", False, f"--{section}{dot}no-{last}")
    reader = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(hint, set()))  # type: ignore[arg-type]
    if not isinstance(reader, PrimitiveConstructorSpec):
        raise TypeError(f"no flag can have the type of {name}, {hint}")
    metavar = next((each.metavar for each in extras if getattr(each, "metavar", None)), reader.metavar)
    names = re.fullmatch(r"\{([^ {}]+)\}", metavar := metavar.removeprefix("{None}|"))
    several = re.sub(r"\[(\w+|\{[^ {}]+\}) \[\1 \.\.\.\]\]", r"\1 ...", metavar)
    value = several if names or several != metavar else metavar.strip("{}")
    shown = "" if default is None or default is MISSING else " ".join(map(str, reader.str_from_instance(default)))
    name = value if tyro.conf.Positional in extras else f"--{name}"
    return Flag(name, value, tuple(names[1].split(",")) if names else (), text, shown, default is MISSING, "", reader)
