"""The config that a command line starts from: a preset, a file, or the run to be resumed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from coop.common.errors import UsageError
from coop.common.imports import hand_over
from coop.common.process.notices import warn
from coop.common.process.untrusted import check_links
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import load_tables, resolve, shortened
from coop.records.reading import read_run_config

_OF_RUNS = ("run-id", "checkpoints", "episodes.csv")  # beside a config.toml


def base_config(args: Sequence[str] | None = None) -> RunConfig:
    """The config given by `--preset`, `--config`, `--method` and `--total-steps`; the other flags override it.

    With `--resume` or `--resume-from` and neither a preset nor a file, it is the config of the run in `--run-dir`.

    Raises:
        UsageError: an unknown preset, a bad file, or both given.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    early.add_argument("--preset")
    early.add_argument("--config", type=_path)
    early.add_argument("--method")
    early.add_argument("--total-steps", "--total_steps", type=int)
    early.add_argument("--run-dir", "--run_dir", type=_path)
    early.add_argument("--resume", action="store_true")
    early.add_argument("--resume-from", "--resume_from")
    try:
        known, _ = early.parse_known_args(sys.argv[1:] if args is None else args)
    except argparse.ArgumentError as error:
        raise UsageError(str(error)) from error
    if known.preset and known.config:
        raise UsageError("--preset and --config: give one of them")
    resumed = known.run_dir if known.resume or known.resume_from else None
    return chosen_config(known.preset, known.config, known.method, known.total_steps, resumed)


def chosen_config(
    preset: str | None, file: Path | None, method: str | None, total_steps: int | None, resumed: Path | None
) -> RunConfig:
    """The config of a preset or a file; of neither, that of the run in the folder `resumed`, or of the preset cartpole.

    Raises:
        UsageError: an unknown preset or method, or a bad file.
    """
    if resumed:
        check_links(resumed)
        if (resumed / "config.toml").exists():
            hand_over(resumed)
    if file and any((file.parent / name).exists() for name in _OF_RUNS):
        hand_over(file.parent)
    saved = resumed and not (preset or file) and resumed / "config.toml"
    if resumed and saved and saved.exists():
        read_run_config(resumed)
        file = saved
    tables = load_tables(None if file else preset or "cartpole", file)
    if file is None and total_steps is not None:
        tables = shortened(tables, total_steps)
    if file and method and "methods" not in tables and method != tables.get("method", method):
        warn(f"{file} has no settings for single methods: {method} gets those of {tables['method']}")
    return resolve(tables, method)


def _path(text: str) -> Path:
    """As `user_path`, which will refuse an empty one with its flag."""
    return Path(text).expanduser()
