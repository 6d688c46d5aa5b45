"""`coop-lockstep`: one run of Algorithm 1 in one process."""

from __future__ import annotations

import sys
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

import torch

from common.config import resolve
from common.errors import UsageError
from common.lifecycle import Stop, run_main
from common.options import RunOptions, parse_run
from experiments.lockstep import Lockstep, finish, newest_epoch
from learner.run_directory import RunDirectory

PROGRESS_EVERY = 5.0  # seconds


@dataclass(frozen=True)
class LockstepOptions(RunOptions):
    """Flags of `coop-lockstep`."""

    resume: bool = False
    """Go on from the newest epoch in --run-dir, to the byte as if nothing had happened."""
    checkpoint_every: int = 10_000
    """Environment steps between epochs."""


def main() -> None:
    """Entry point."""
    run_main("coop-lockstep", _run)


def _run() -> None:
    options = parse_run(LockstepOptions, "coop-lockstep", "Run Algorithm 1 exactly, in one process without a network.")
    config = options.run_config()
    if options.checkpoint_every < 1:
        raise UsageError(f"--checkpoint-every {options.checkpoint_every}: must be at least 1")
    torch.set_num_threads(config.learner.threads)
    path = _resumed(options) if options.resume else options.directory()
    stop = Stop()
    stop.on_signals()
    started = time.monotonic()
    run = Lockstep(config)
    epoch = newest_epoch(path) if options.resume else None
    sizes = None if epoch is None else run.restore(epoch)
    with RunDirectory(path, config, sizes) as directory:
        _play(run, directory, stop, options.checkpoint_every)
        outcome = stop.reason or "complete"
        values = finish(run, directory, started, outcome)
    run.env.close()
    print(
        f"{outcome}: {run.step:,} steps, {run.agent.updates:,} updates, return of the last 100 episodes "
        f"{values['return_mean_100']:.1f} ({values['return_sd_100']:.1f}), {values['wall_seconds']:.0f} s; {path}"
    )


def _resumed(options: LockstepOptions) -> Path:
    """The run directory to go on with; its config must be the one that the flags say."""
    path = options.run_dir
    if path is None or not (path / "config.toml").exists():
        raise UsageError(f"--resume: no run in --run-dir {path}")
    if resolve(tomllib.loads((path / "config.toml").read_text(encoding="utf-8"))) != options.run_config():
        raise UsageError(f"--resume: {path / 'config.toml'} differs from the flags; give the same, or --config with it")
    return path


def _play(run: Lockstep, directory: RunDirectory, stop: Stop, checkpoint_every: int) -> None:
    config, due = run.config, time.monotonic() + PROGRESS_EVERY
    while run.step < config.total_steps and not stop.is_set():
        run.play(directory)
        if run.step % checkpoint_every == 0 and run.step < config.total_steps:
            directory.flush()
            run.save(directory.path)
        if time.monotonic() >= due:
            due = time.monotonic() + PROGRESS_EVERY
            text = f"step {run.step:,}/{config.total_steps:,}  return {run.telemetry.return_mean:.1f}"
            print(text, end="\r" if sys.stdout.isatty() else "\n", flush=True)
