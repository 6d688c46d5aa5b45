"""Parses command lines with tyro, and reports errors in one line."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any, NoReturn, TypeVar, get_type_hints

import tyro
from tyro import _errors as tyro_errors  # private; pyproject.toml pins the version

from common.errors import UsageError

T = TypeVar("T")


def parse(
    kind: type[T], program: str, description: str, default: T | None = None, args: Sequence[str] | None = None
) -> T:
    """Parse flags into a dataclass.

    Raises:
        UsageError: an unknown flag or a value of the wrong type.
    """

    def refuse(event: tyro_errors.ParseErrorEvent) -> NoReturn:
        raise UsageError(_problem(event, list(flags(kind))))

    with tyro_errors.on_parse_error(refuse):
        if default is None:
            return tyro.cli(kind, prog=program, description=description, args=args)
        return tyro.cli(kind, prog=program, description=description, args=args, default=default)


def flags(kind: type[Any], prefix: str = "") -> Iterator[str]:
    """The flags of a dataclass and of those nested in it, as tyro names them: "--learner.swap-every"."""
    hints = get_type_hints(kind)
    for field in dataclasses.fields(kind):
        name = prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(inner := hints[field.name]):
            assert isinstance(inner, type)
            yield from flags(inner, f"{name}.")
        else:
            yield f"--{name}"


def given_flags(args: Sequence[str]) -> set[str]:
    """The fields that a command line sets, as dotted names ("learner.swap_every"); `--learner.no-double` counts."""
    names = {token[2:].partition("=")[0].replace("-", "_") for token in args if token.startswith("--")}
    return names | {name.replace(".no_", ".") for name in names}


def _problem(event: tyro_errors.ParseErrorEvent, known: Sequence[str]) -> str:
    """Describe a parse error in one line."""
    match event:
        case tyro_errors.UnrecognizedArgs(tokens=[first, *_]):
            flag = first.partition("=")[0].replace("_", "-")
            near = get_close_matches(flag, [name for name in known if name != flag], n=1)
            return f"{first}: unknown{f'; perhaps {near[0]}' if near else ''}; --help lists what there is"
        case tyro_errors.InvalidChoice(argument=argument, value=value, choices=choices):
            return f"{argument.display_name()} {value}: allowed: {', '.join(choices)}"
        case tyro_errors.MissingArgs(missing_arguments=missing):
            return f"missing: {', '.join(one.arg.display_name() for one in missing)}"
        case tyro_errors.BadValue(argument=argument):
            return f"{argument.display_name()}: needs a value"
        case tyro_errors.InstantiationFailure(message=message, argument=argument):
            return f"{argument.display_name()}: {message}; allowed: {argument.lowered.metavar}" if argument else message
    return "the command line can't be read; --help lists what there is"
