"""`coop-eval`: plays a run's newest checkpoint greedily."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from common.errors import UsageError
from common.process.cli import parse
from common.process.lifecycle import run_main


@dataclass(frozen=True)
class EvalOptions:
    """Flags of `coop-eval`."""

    run_dir: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN_DIR")]
    """Folder of a run, with its config.toml and checkpoints."""
    episodes: int = 20
    """Number of full episodes to play."""
    seed: int = 0
    """Seed of the emulator."""


def main() -> None:
    """Entry point."""
    run_main("coop-eval", _run)


def _run() -> None:
    options = parse(EvalOptions, "coop-eval", "Play the newest checkpoint of a run, always with its best action.")
    if options.episodes < 1:
        raise UsageError(f"--episodes {options.episodes}: must be at least 1")
    if options.seed < 0:
        raise UsageError(f"--seed {options.seed}: must be at least 0")
    from experiments.evaluation import evaluate_checkpoint  # noqa: PLC0415 (torch takes seconds; wrong flags should not)

    done = evaluate_checkpoint(options.run_dir, options.episodes, options.seed)
    mean, sd = done.mean, done.sd
    print(
        f"return of {len(done.returns)} greedy episodes: mean {mean:.2f}, sd {sd:.2f}, least {min(done.returns):g}, "
        f"most {max(done.returns):g}; network {done.network} of checkpoint {done.epoch} in {options.run_dir}"
    )
