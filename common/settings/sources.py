"""The config that a command line starts from: a preset, a file, or the run to be resumed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from common.errors import UsageError
from common.process.notices import warn
from common.settings.config import RunConfig
from common.settings.tables import load_tables, resolve, shortened


def base_config(args: Sequence[str] | None = None) -> RunConfig:
    """The config given by `--preset`, `--config`, `--method` and `--total-steps`; the other flags override it.

    With `--resume` and neither a preset nor a file, it is the config of the run in `--run-dir`.

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
    if file and known.method and "methods" not in tables and known.method != tables.get("method", known.method):
        warn(f"{file} has no settings for single methods: {known.method} gets those of {tables['method']}")
    return resolve(tables, known.method)
