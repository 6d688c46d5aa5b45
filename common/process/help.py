"""The help of a command: a short one with the flags that most people need, and one with all of them."""

from __future__ import annotations

import re
import shutil
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

from coop.common.process.flags import SHELLS, Flag, Section

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
