"""`coop-eval`: plays the networks of saved runs, or those of a run that goes on."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional

from coop.common.errors import UsageError
from coop.common.imports import permit
from coop.common.numbers import exact
from coop.common.places import shown
from coop.common.process import cli
from coop.common.process.lifecycle import raise_on_signals, run_main
from coop.common.process.output import out
from coop.common.settings.options import RoleOptions

if TYPE_CHECKING:
    from coop.evaluation.evaluate import CheckpointEvaluation

ABOUT = (
    "Play the newest checkpoint of runs, each network and their mean, greedily and with some random actions; or, with "
    "--run or --connect, the acting network of a run that goes on, again and again."
)
EPISODES = 20
EPSILONS = (0.0, 0.05)
HEAD = "checkpoint  network  epsilon  episodes       mean        95% interval        sd    least     most"
_NETWORKS: dict[str, Literal["mean", 1, 2]] = {"1": 1, "2": 2, "mean": "mean"}
_OF_FOLDERS = {"seed", "networks", "video"}
_OF_LIVE_RUNS = {"every", "every_steps", "join_timeout", "patience", "zenoh_config", "shared_memory"}


@dataclass(frozen=True)
class EvalOptions(RoleOptions):
    """Flags of `coop-eval`."""

    run_dir: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN_DIR")] = ()
    """Folders of runs, with their config.toml and checkpoints."""
    episodes: int | None = None
    """Full episodes to play: 20 for each network of a folder; a live run's eval_episodes at each evaluation."""
    networks: tuple[Literal["1", "2", "mean"], ...] = ("1", "2", "mean")
    """Which networks of a folder to play; mean takes the mean of both networks' Q-values."""
    epsilon: tuple[float, ...] = ()
    """Probabilities of a random action: 0 (greedy play) and 0.05 for a folder, 0 for a live run."""
    envs: int = 8
    """Emulators that play at once."""
    seed: int = 0
    """Seed of the emulators that play a folder's networks."""
    video: Path | None = None
    """An .mp4 or .gif to film an episode in, its first 9,000 steps (.gif: 3,000) at most: one folder's acting network,
    or the one of --networks, plays with the first --epsilon."""
    every: float | None = None
    """Seconds between the evaluations of a live run; without this and the next, the run's eval_every steps."""
    every_steps: int | None = None
    """Environment steps between the evaluations of a live run."""
    allow_import: tuple[str, ...] = ()
    """Modules, such as my_envs, that may be imported: for a live run's environment or network, or for a folder's even
    if they lie in it or beside it."""


def main() -> None:
    """Entry point."""
    raise_on_signals()
    run_main("coop-eval", _run)


def _run() -> None:
    options = cli.parse(EvalOptions, "coop-eval", ABOUT)
    given = cli.given_flags(sys.argv[1:])
    live = bool({"run", "connect"} & given)
    _check(options, given, live)
    permit(options.allow_import)
    # Imported only after the flags have been checked: torch takes seconds.
    if live:
        from coop.evaluation.evaluator import EvaluationPlan, evaluate_run  # noqa: PLC0415

        epsilon = options.epsilon[0] if options.epsilon else 0.0
        plan = EvaluationPlan(options.every, options.every_steps, options.episodes, epsilon, options.envs)
        evaluate_run(options, options.allow_import, plan)
        return
    from coop.evaluation.evaluate import evaluate_checkpoint, film_checkpoint  # noqa: PLC0415

    networks = [_NETWORKS[name] for name in options.networks]
    episodes, epsilons = options.episodes or EPISODES, options.epsilon or EPSILONS
    if options.video is not None:
        line = film_checkpoint(options.run_dir[0], options.video, options.seed, networks, epsilons[0])
        print(line, file=out(), flush=True)
    runs = [
        evaluate_checkpoint(path, episodes, options.seed, networks, epsilons, options.envs) for path in options.run_dir
    ]
    width = max(len(str(shown(path))) for path in options.run_dir)
    print(f"{'run':{width}}  {HEAD}", file=out(), flush=True)
    for run in runs:
        for one in run:
            print(f"{shown(Path(one.run))!s:{width}}  {_row(one)}", file=out(), flush=True)


def _row(one: CheckpointEvaluation) -> str:
    network, (low, high) = f"{one.network}{' acts' if one.acts else ''}", one.interval
    played = f"{one.checkpoint:10}  {network:7}  {one.epsilon:7g}  {len(one.returns):8}"
    spread = f"{one.sd:8.2f}  {exact(min(one.returns)):>7}  {exact(max(one.returns)):>7}"
    return f"{played}  {one.mean:9.2f}  {f'{low:.2f} to {high:.2f}':>18}  {spread}"


def _check(options: EvalOptions, given: set[str], live: bool) -> None:
    """Raise UsageError for a value that is not allowed, and for flags that do not belong together."""
    for name, value, least in (
        ("episodes", options.episodes, 1),
        ("envs", options.envs, 1),
        ("seed", options.seed, 0),
        ("every", options.every, 0),
        ("every-steps", options.every_steps, 1),
    ):
        if value is not None and not value >= least:
            raise UsageError(f"--{name} {value}: must be at least {least}")
    for epsilon in options.epsilon:
        if not 0 <= epsilon <= 1:
            raise UsageError(f"--epsilon {epsilon:g}: must be from 0 to 1")
    if live == bool(options.run_dir):
        what = "not both" if live else "coop-eval RUN_DIR, or coop-eval --run NAME --connect ENDPOINT"
        raise UsageError(f"needs folders of runs, or --run or --connect for a run that goes on: {what}")
    if options.video is not None and len(options.run_dir) > 1:
        raise UsageError(f"--video {options.video}: of one run; there are {len(options.run_dir)}")
    if options.every is not None and options.every_steps is not None:
        raise UsageError("--every and --every-steps: give one of them")
    if live and len(options.epsilon) > 1:
        raise UsageError(f"--epsilon {' '.join(map(str, options.epsilon))}: one value for a run that goes on")
    if misplaced := sorted(given & (_OF_FOLDERS if live else _OF_LIVE_RUNS)):
        where = "the folder of a run" if live else "a run that goes on, --run or --connect"
        raise UsageError(f"--{misplaced[0].replace('_', '-')}: for {where}")
