"""Command lines: parses flags with tyro, answers --help and its like, and reports errors in one line."""

from __future__ import annotations

import io
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr, suppress
from dataclasses import fields, replace
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from coop.common.errors import ALSO_CALLED, UsageError, closest, not_among, refusal
from coop.common.places import absolute
from coop.common.process.flags import READERS, Flag, Section, sections
from coop.common.process.lifecycle import ProcessExit

SHELLS = ("bash", "zsh", "fish")
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
    flags = {flag.name: flag for flag in _flags(parts)}
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
ANSWERS = ("--help", "--help-all", "--version", "--completion")

T = TypeVar("T")


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
    parts = cache(partial(sections, kind, default))  # takes a tenth of a second, which most command lines need not
    args = _separated(_with_values(sys.argv[1:] if args is None else args), parts)
    asked = {token.partition("=")[0].replace("_", "-") for token in args}
    if "--help-all" in asked:
        _answer(full_help(program, description, parts()))
    if asked & {"-h", "--help"}:
        _answer(short_help(program, description, parts(), common))
    if "--version" in asked:
        _answer(f"{program} {version(PACKAGE)}")
    read: Callable[..., tuple[T, list[str]]] = partial(
        tyro.cli, kind, prog=program, default=tyro.MISSING_NONPROP if default is None else default
    )
    if "--completion" in asked:
        with suppress(SystemExit):
            read(args=["--tyro-write-completion", _shell(args), "-"], registry=READERS)
        raise ProcessExit(0)
    try:
        with redirect_stderr(io.StringIO()):
            # tyro shows no help, and need not look for its texts
            options, unknown = read(
                args=args,
                registry=READERS,
                add_help=False,
                return_unknown_args=True,
                description="",
                config=(tyro.conf.HelptextFromCommentsOff,),
            )
    except SystemExit:
        raise UsageError(_problem(args, _flags(parts()))) from None
    if unknown:
        raise UsageError(f"{unknown[0]}: {_unknown(unknown[0], _flags(parts()))}")
    return _with_absolute_paths(options)


def _flags(parts: Iterable[Section]) -> list[Flag]:
    return [flag for part in parts for flag in part.flags]


def _with_values(args: Sequence[str]) -> list[str]:
    """The command line, in which each flag of `_ALONE` has a value."""
    words: list[str] = []
    for token, after in zip(args, (*args[1:], "--"), strict=False):
        words.append(token)
        if token in _ALONE and after.startswith("-"):
            words.append(_ALONE[token])
    return words


def _separated(args: Sequence[str], parts: Callable[[], list[Section]]) -> list[str]:
    """The command line, in which numbers joined by commas are given one by one to flags that take several."""
    if not any(map(_JOINED.fullmatch, args)):
        return list(args)
    several = {flag.name for flag in _flags(parts()) if flag.value.endswith("...")}
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


def _problem(args: Sequence[str], flags: Sequence[Flag]) -> str:
    """Why tyro has refused a command line, in one line."""
    given = _assigned(args, flags)
    for flag in flags:
        if flag.reader and flag.name in given and (problem := _misread(flag, flag.reader, given[flag.name])):
            return problem
    if "" in given:
        return f"{given[''][0]}: {_unknown(given[''][0], flags)}"
    missing = ", ".join(flag.name for flag in flags if flag.required and flag.name not in given)
    return f"missing: {missing}" if missing else "the command line can't be read; --help-all lists every flag"


def _assigned(args: Sequence[str], flags: Sequence[Flag]) -> dict[str, list[str]]:
    """The words of each given flag and positional argument, by its name; those that belong to none by ""."""
    known = {name: flag for flag in flags for name in (flag.name, flag.negative) if name.startswith("-")}
    positional = [flag for flag in flags if not flag.name.startswith("-")]
    given: dict[str, list[str]] = {}
    current: Flag | None = None
    for token in args:
        name, joined, value = token.partition("=")
        if flag := known.get(name.replace("_", "-")):
            current, given[flag.name] = flag, [value] if joined else []
            continue
        count = current.reader.nargs if current and current.reader else 0
        if token.startswith("--"):
            current = None
        elif current is None or (isinstance(count, int) and len(given[current.name]) >= count):
            current = positional.pop(0) if positional else None
        given.setdefault(current.name if current else "", []).append(token)
    return given


def _misread(flag: Flag, reader: PrimitiveConstructorSpec[Any], words: list[str]) -> str | None:
    """Why a flag's words are no value of it; None if they are one."""
    if isinstance(reader.nargs, int) and len(words) < reader.nargs:
        return f"{flag.name}: needs a value"
    for word in words:
        if reader.choices and word not in reader.choices:
            return f"{flag.name} {word}: {not_among(reader.choices, word)}"
    try:
        with READERS:
            reader.instance_from_str(words)
    except ValueError as error:
        quoted = " ".join(map(repr, words))
        text, _, _ = str(error).partition("\n")
        reason = text if text.startswith(quoted) else "an empty value" if words == [""] else f"can't read {quoted}"
        unset = ", or None" if "{None}|" in reader.metavar else ""
        return f"{flag.name}: {reason}; allowed: {flag.value}{unset}"
    return None


def _flag(name: str) -> str:
    """The flag of a field's dotted name."""
    return f"--{name.replace('_', '-')}"


def _unknown(token: str, flags: Iterable[Flag]) -> str:
    """What to say of an unknown word; of a flag with the one that it resembles, with or without its section.

    Of the name of a section, with the section's first flag.
    """
    word = token.partition("=")[0].replace("_", "-")
    known = {name: name for flag in flags for name in (flag.name, flag.negative)}
    if not token.startswith("-"):
        return refusal("unknown", known.get(f"--{word}"), "it follows no flag that takes it")
    elsewhere = ALSO_CALLED.get(word[2:].replace("-", "_"), "")
    first = known.get(_flag(elsewhere)) or next((name for name in known if name.startswith(f"{word}.")), None)
    without = {f"--{name.rpartition('.')[2]}": name for name in reversed(known) if "." in name}
    known = {**without, **known, **{name: name for name in ANSWERS}}
    near = first or closest(word, known)
    return refusal("unknown", near and known[near], "--help-all lists every flag")
