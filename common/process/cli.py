"""Parses command lines with tyro, answers --help and its like, and reports errors in one line."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import tyro
from tyro import _errors as tyro_errors  # private; pyproject.toml pins the version
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from coop.common.errors import UsageError
from coop.common.places import absolute, user_path
from coop.common.process.flags import SHELLS, completion, placeholder, sections
from coop.common.process.help import full_help, short_help
from coop.common.process.lifecycle import ProcessExit
from coop.common.suggestions import closest, not_among, refusal

PACKAGE = "coop-rl"
_JOINED = re.compile(r"((?P<flag>--[^=]+)=)?(?P<numbers>[-+.\de_]+(,[-+.\de_]+)+)")
_ALSO_CALLED = {  # what other libraries call a flag
    "--lr": "--learner.learning-rate",
    "--discount": "--learner.gamma",
    "--buffer-size": "--replay.capacity",
    "--target-update-interval": "--learner.target-update-every",
    "--n-envs": "--actor.envs",
    "--timesteps": "--total-steps",
    "--total-timesteps": "--total-steps",
    "--n-steps": "--replay.n-step",
}
ANSWERS = ("--help", "--help-all", "--version", "--completion")

T = TypeVar("T")

_PATHS = ConstructorRegistry()


@_PATHS.primitive_rule
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


@_PATHS.primitive_rule
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


def whole_number(text: str) -> int:
    """Read a whole number: 1000000, 1_000_000 or 1e6."""
    try:
        return int(text)
    except ValueError:
        with suppress(ValueError):
            if (number := float(text)).is_integer():
                return int(number)
        raise


def parse(
    kind: type[T],
    program: str,
    description: str,
    default: T | None = None,
    args: Sequence[str] | None = None,
    common: Sequence[str] = (),
) -> T:
    """Parse flags into a dataclass.

    common: the flags that --help shows; all if empty.

    Raises:
        UsageError: an unknown flag or a value of the wrong type.
        ProcessExit: the flags asked for help, the version or a completion script; it has been printed.
    """
    args = _separated(sys.argv[1:] if args is None else args, kind, default)
    asked = {token.partition("=")[0].replace("_", "-") for token in args}
    if "--help-all" in asked:
        _answer(full_help(program, description, sections(kind, default)))
    if asked & {"-h", "--help"}:
        _answer(short_help(program, description, sections(kind, default), common))
    if "--version" in asked:
        _answer(f"{program} {version(PACKAGE)}")
    if "--completion" in asked:
        _answer(completion(kind, default, program, _shell(args)))

    def refuse(event: tyro_errors.ParseErrorEvent) -> NoReturn:
        raise UsageError(_problem(event, kind))

    with _PATHS, tyro_errors.on_parse_error(refuse):
        if default is None:
            return _with_absolute_paths(tyro.cli(kind, prog=program, args=args, add_help=False))
        return _with_absolute_paths(tyro.cli(kind, prog=program, args=args, add_help=False, default=default))


def _separated(args: Sequence[str], kind: type[Any], default: object) -> list[str]:
    """The command line, in which numbers joined by commas are given one by one to flags that take several."""
    if not any(_JOINED.fullmatch(token) for token in args):
        return list(args)
    several = {flag.name for part in sections(kind, default) for flag in part.flags if flag.value.endswith("...")}
    words: list[str] = []
    flag = ""
    for token in args:
        found = _JOINED.fullmatch(token)
        flag = (found and found["flag"]) or (token if token.startswith("--") else flag)
        if found and flag.replace("_", "-") in several:
            words += [*([flag] if found["flag"] else []), *found["numbers"].split(",")]
        else:
            words.append(token)
    return words


def given_flags(args: Sequence[str]) -> set[str]:
    """The fields that a command line sets, as dotted names ("learner.swap_every"); `--learner.no-double` counts."""
    names = {token[2:].partition("=")[0].replace("-", "_") for token in args if token.startswith("--")}
    return names | {name.replace(".no_", ".") for name in names}


def _with_absolute_paths(options: T) -> T:
    """The options, whose paths mean the same wherever users' code goes."""
    changed: dict[str, Any] = {}
    for field in fields(options):  # type: ignore[arg-type] # always a dataclass
        match getattr(options, field.name):
            case Path() as path:
                changed[field.name] = absolute(path)
            case (Path(), *_) as paths:
                changed[field.name] = tuple(map(absolute, paths))
    return replace(options, **changed) if changed else options  # type: ignore[type-var]


def _answer(text: str) -> NoReturn:
    print(text)
    raise ProcessExit(0)


def _shell(args: Sequence[str]) -> str:
    """The shell that --completion names."""
    words = [word for token in args for word in token.split("=", 1)]
    following = words[words.index("--completion") + 1 :]
    shell = following[0] if following else ""
    if shell not in SHELLS:
        text = not_among(SHELLS, shell, "unknown shell" if shell else "needs a shell")
        raise UsageError(f"--completion {shell}".rstrip() + f": {text}")
    return shell


def _problem(event: tyro_errors.ParseErrorEvent, kind: type[Any]) -> str:
    """Describe a parse error in one line."""
    match event:
        case tyro_errors.UnrecognizedArgs(tokens=[first, *_]):
            return f"{first}: {_unknown(first, kind)}"
        case tyro_errors.InvalidChoice(argument=argument, value=value, choices=choices):
            return f"{argument.display_name()} {value}: {not_among(choices, value)}"
        case tyro_errors.MissingArgs(missing_arguments=missing):
            args = [one.arg for one in missing]
            names = [placeholder(arg) if arg.is_positional() else arg.display_name() for arg in args]
            return f"missing: {', '.join(names)}"
        case tyro_errors.BadValue(argument=argument):
            return f"{argument.display_name()}: needs a value"
        case tyro_errors.InstantiationFailure(message=message, argument=argument) if argument:
            unset = ", or None" if (argument.lowered.metavar or "").startswith("{None}|") else ""
            return f"{argument.display_name()}: {_reason(message)}; allowed: {placeholder(argument)}{unset}"
    return "the command line can't be read; --help-all lists every flag"


def _reason(message: str) -> str:
    """Why a value cannot be read, in one line; tyro's own messages show types and have several."""
    first = message.partition("\n")[0]
    value = re.search(r"(?: from|arguments:|base 10:|to float:) (.+?)\.?$", first)
    if value and value[1] in ("''", "['']"):
        return "an empty value"
    return f"can't read {value[1]}" if value else first


def _unknown(token: str, kind: type[Any]) -> str:
    """What to say of an unknown word; of a flag with the one that it resembles, with or without its section.

    Of the name of a section, with the section's first flag.
    """
    word = token.partition("=")[0].replace("_", "-")
    known = {name: name for part in sections(kind) for each in part.flags for name in (each.name, each.negative)}
    if not token.startswith("-"):
        return refusal("unknown", known.get(f"--{word}"), "it follows no flag that takes it")
    first = known.get(_ALSO_CALLED.get(word, "")) or next((name for name in known if name.startswith(f"{word}.")), None)
    without = {f"--{name.rpartition('.')[2]}": name for name in reversed(known) if "." in name}
    known = {**without, **known, **{name: name for name in ANSWERS}}
    near = first or closest(word, known)
    return refusal("unknown", near and known[near], "--help-all lists every flag")
