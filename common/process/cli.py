"""Command lines: parses flags with tyro, answers --help and its like, and reports errors in one line."""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import tyro
from tyro import _arguments as tyro_arguments  # private, as the two below; pyproject.toml pins the version
from tyro import _errors as tyro_errors  # private; pyproject.toml pins the version
from tyro import _parsers as tyro_parsers
from tyro import _strings as tyro_strings
from tyro._backends import _tyro_backend as tyro_backend
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from coop.common.errors import UsageError, closest, not_among, refusal
from coop.common.places import absolute, user_path
from coop.common.process.lifecycle import ProcessExit

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


EXIT_STATUSES = (
    ("0", "It has done what it was asked to do."),
    ("1", "It could not start or finish, or lost a process that it needs; the last line on stderr says why."),
    ("2", "A flag, a file or a setting is wrong; nothing has begun. One line on stderr says what is allowed."),
    (
        "129, 130, 141, 143",
        "SIGHUP (the terminal has gone), SIGINT (Ctrl-C), output that nobody reads any more, or SIGTERM has ended it; "
        "where there is --resume, that goes on from there.",
    ),
)
_WIDEST = 100  # columns
_INDENT = 28  # column of the texts
_LONGEST = 44  # characters of a list of allowed values that stands beside the flag

_ABOUT = (
    ("-h, --help", "Show the flags that most runs need; all of them where there are few."),
    ("--help-all", "Show all flags and the exit statuses."),
    ("--version", "Show the version."),
    (f"--completion {{{','.join(SHELLS)}}}", "Write a script for this shell, which completes flags and values."),
)


def short_help(program: str, description: str, parts: Sequence[Section], common: Sequence[str] = ()) -> str:
    """The flags named in `common`, in that order, with the first clause of their texts; all flags if it is empty.

    It fits two screens of 80 x 24.
    """
    flags = {flag.name: flag for flag in chain.from_iterable(part.flags for part in parts)}
    chosen = [flags[name] for name in common if name in flags]
    shown = [replace(flag, text=re.split("[;.]( |$)", flag.text)[0] + ".") for flag in chosen] or list(flags.values())
    rest = f"all {len(flags)} flags, " if len(shown) < len(flags) else ""
    also = _wrapped(f"Also: --help-all ({rest}exit statuses), --version, --completion SHELL.")
    return "\n".join([*_head(program, description, parts), *_entries(map(_row, shown)), "", *also])


def full_help(program: str, description: str, parts: Sequence[Section]) -> str:
    """Every flag, by section, and the exit statuses."""
    lines = _head(program, description, parts)
    for part in filter(lambda part: part.flags, parts):
        lines += _wrapped(f"{part.name}: {part.text}") if part.name else []
        lines += [*_entries(_row(flag, full=True) for flag in part.flags), ""]
    return "\n".join([*lines, "about this command:", *_entries(_ABOUT), "", "exit status:", *_entries(EXIT_STATUSES)])


def _head(program: str, description: str, parts: Sequence[Section]) -> list[str]:
    words = [_usage(flag) for part in parts for flag in part.flags if flag.required or flag.name == flag.value]
    return [f"usage: {' '.join([program, *words, '[FLAGS]'])}", "", *_wrapped(description), ""]


def _usage(flag: Flag) -> str:
    if flag.name != flag.value:
        return f"{flag.name} {flag.value}"
    return flag.name if flag.required else f"[{flag.name} ...]"


def _row(flag: Flag, full: bool = False) -> tuple[str, str]:
    """A flag as the help shows it, and its text with allowed values and the default."""
    value, text = flag.value, flag.text
    if len(value) > _LONGEST:
        value, text = "NAME", f"{text} Allowed: {', '.join(flag.choices)}."
    name = flag.name if flag.name == flag.value else f"{flag.name} {value}".rstrip()
    if flag.negative and (full or flag.default == "on"):
        name = f"{name}, {flag.negative}"
    hint = " (required)" if flag.required else f" (default: {flag.default})" if flag.default else ""
    return name, text + hint


def _entries(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Names with their texts beside them, or below long ones."""
    for name, text in rows:
        head = f"  {name}"
        lines = textwrap.wrap(text, _width() - _INDENT, break_on_hyphens=False) or [""]
        if len(head) < _INDENT - 1:
            yield head.ljust(_INDENT) + lines.pop(0)
        else:
            yield head
        yield from (" " * _INDENT + line for line in lines)


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, _width(), break_on_hyphens=False)


def _width() -> int:
    return max(2 * _INDENT, min(shutil.get_terminal_size().columns, _WIDEST))


PACKAGE = "coop-rl"
_ALONE = {"--replay.journal": "async"}  # what flags mean that are given without a value
_JOINED = re.compile(r"((?P<flag>--[^=]+)=)?(?P<numbers>[-+.\de_]+(,[-+.\de_]+)+)")
_ALSO_CALLED = {  # what other libraries call a flag
    "--lr": "--learner.learning-rate",
    "--discount": "--learner.gamma",
    "--buffer-size": "--replay.capacity",
    "--target-update-interval": "--learner.target-update-every",
    "--n-envs": "--actor.num-envs",
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
    args = _separated(_with_values(sys.argv[1:] if args is None else args), kind, default)
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


def _with_values(args: Sequence[str]) -> list[str]:
    """The command line, in which each flag of `_ALONE` has a value."""
    words: list[str] = []
    for token, after in zip(args, (*args[1:], "--"), strict=False):
        words.append(token)
        if token in _ALONE and after.startswith("-"):
            words.append(_ALONE[token])
    return words


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
