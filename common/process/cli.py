"""Command lines by tyro; whatever is wrong with them comes out as one line."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import tyro

from common.errors import UsageError
from common.settings.config import RunConfig
from common.settings.tables import load_tables, resolve, shortened

T = TypeVar("T")
_FRAME = re.compile(r"[╭╮╰╯│─]+")


def parse(
    kind: type[T], program: str, description: str, default: T | None = None, args: Sequence[str] | None = None
) -> T:
    """Parse flags into a dataclass.

    Raises:
        UsageError: an unknown flag or a value of the wrong type.
    """
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            if default is None:
                return tyro.cli(kind, prog=program, description=description, args=args)
            return tyro.cli(kind, prog=program, description=description, args=args, default=default)
    except SystemExit as exit_:
        if exit_.code in (0, None):
            raise
        raise UsageError(_one_line(complaint.getvalue())) from None


def base_config(args: Sequence[str] | None = None) -> RunConfig:
    """The config that `--preset`, `--config`, `--method` and `--total-steps` name; the other flags override it.

    With `--resume` and neither a preset nor a file it is that of the run in `--run-dir`.

    Raises:
        UsageError: an unknown preset, a bad file, or both given.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    early.add_argument("--preset")
    early.add_argument("--config", type=Path)
    early.add_argument("--method")
    early.add_argument("--total-steps", "--total_steps", type=int)
    early.add_argument("--run-dir", "--run_dir", type=Path)
    early.add_argument("--resume", action="store_true")
    try:
        known, _ = early.parse_known_args(sys.argv[1:] if args is None else args)
    except argparse.ArgumentError as error:
        raise UsageError(str(error)) from error
    if known.preset and known.config:
        raise UsageError("--preset and --config: give one of them")
    preset, file = known.preset, known.config
    if known.resume and known.run_dir and not (preset or file):
        saved = known.run_dir / "config.toml"
        file = saved if saved.exists() else None
    if not file:
        preset = preset or "cartpole"
    tables = load_tables(preset, file)
    if preset and known.total_steps is not None:
        tables = shortened(tables, known.total_steps)
    return resolve(tables, known.method)


def _one_line(box: str) -> str:
    """The statement inside the box that tyro draws around an error, and the flag that it suggests."""
    body = box.split("\n", 1)[1] if box.startswith("╭") else box
    statement, _, advice = body.partition("│ ─")
    text = re.sub(r"\s+", " ", _FRAME.sub(" ", statement)).strip() or "bad command line"
    meant = re.search(r"Perhaps you meant:[\s│]*(--\S+)", advice)
    return f"{text}; perhaps {meant[1]}" if meant else text
