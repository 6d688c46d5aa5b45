"""`coop-plan`: the cores, memory and network that a run needs, and what limits it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from common.envs.make import env_spec
from common.errors import UsageError
from common.process.cli import parse
from common.process.importing import importing
from common.process.lifecycle import raise_on_signals, run_main
from common.settings.config import RunConfig
from common.settings.tables import load_tables, preset_names, resolve, validated
from common.types import EnvSpec
from deploy.sizing import COSTS, Sizing, enough_actors, size

TABLE = (10, 100, 1_000, 10_000)  # actors


@dataclass(frozen=True)
class PlanOptions:
    """Flags of `coop-plan`."""

    actors: int = 1
    """Actor processes, with a core each."""
    env: Annotated[str, tyro.conf.arg(metavar=f"{{{','.join(preset_names())}}}")] = "breakout"
    """Preset of the run."""
    method: str | None = None
    """Training method; the preset's if not given."""
    ratio: float | None = None
    """Updates per environment step; the preset's if not given."""
    learner_speedup: float = 1.0
    """How many times as fast as one core of the measured machine the learner computes, for example on a GPU."""
    gbits: float = 10.0
    """Bandwidth of the learner's host, and of the replay service's, in Gbit/s in each direction."""
    table: bool = False
    """Print a table in Markdown for 10, 100, 1,000 and 10,000 actors instead; docs/scaling.md has two."""


def main() -> None:
    """Entry point."""
    raise_on_signals()
    run_main("coop-plan", _run)


def _run() -> None:
    options = parse(PlanOptions, "coop-plan", "Print what a run needs, and what limits it.")
    for name in ("actors", "learner_speedup", "gbits"):
        if not getattr(options, name) > 0:
            raise UsageError(f"--{name.replace('_', '-')} {getattr(options, name)}: must be positive")
    config, spec = planned(options.env, options.method, options.ratio)
    with importing():
        from common.networks.network import build_network  # noqa: PLC0415 (torch takes seconds)

    network = build_network(config.network.kind, spec, config.network.hidden, seed=0)
    parameters = sum(parameter.numel() for parameter in network.parameters())
    sizings = [
        size(COSTS[options.env], config, spec, parameters, actors, options.learner_speedup, options.gbits)
        for actors in (TABLE if options.table else (options.actors,))
    ]
    print(table(config, sizings) if options.table else page(config, options.env, sizings[0]))


def planned(preset: str, method: str | None, ratio: float | None) -> tuple[RunConfig, EnvSpec]:
    """The config of a preset and its environment; raises UsageError."""
    config = resolve(load_tables(preset, None), method)
    if ratio is not None:
        config = validated(replace(config, replay=replace(config.replay, ratio=ratio)))
    return config, env_spec(config.env)


def page(config: RunConfig, preset: str, sizing: Sizing) -> str:
    """The printed page."""
    speed, limit, actors = sizing.speed, sizing.bottleneck, sizing.parts[0]
    updates, traffic = speed * config.replay.ratio, sizing.traffic
    lines = [
        f"{preset}, {config.method}: {actors.cores:,} actors of {config.actor.envs} emulators, "
        f"{config.replay.ratio:g} updates per step",
        "",
        f"{'':16}{'cores':>7}{'memory':>12}{'steps/s at most':>18}{'busy':>7}",
        *(
            f"{part.name:16}{part.cores or '':>7}{f'{part.memory / 2**30:,.1f} GiB' if part.memory else '':>12}"
            f"{part.most:18,.0f}{min(1, speed / part.most):7.0%}"
            for part in sizing.parts
        ),
        "",
        f"speed       {speed:,.0f} steps/s, {updates:,.1f} updates/s",
        f"inserts     {speed / config.actor.segment_steps:,.1f} messages/s, {speed * traffic.inserts / 1e6:,.1f} MB/s",
        f"draws       {updates:,.1f} messages/s, {speed * traffic.draws / 1e6:,.1f} MB/s",
        f"weights     {updates / config.learner.publish_every * actors.cores:,.1f} messages/s, "
        f"{speed * traffic.weights / 1e6:,.1f} MB/s, {sizing.weights_delivered:.0%} of them delivered",
        f"bottleneck  {limit.name}: {limit.remedy}",
    ]
    if limit is not actors:
        lines.append(f"            {enough_actors(sizing):,} of the {actors.cores:,} actors would keep it busy")
    return "\n".join(lines)


def table(config: RunConfig, sizings: Sequence[Sizing]) -> str:
    """A table in Markdown with a line for each sizing."""
    names = ("actors", "steps/s", "updates/s", "inserts, MB/s", "draws, MB/s", "weights, MB/s", "delivered")
    rows = [(*names, "memory of the services", "saturates first", "actors that suffice"), ["---"] * 10]
    for sizing in sizings:
        actors, replay, learner, *_ = sizing.parts
        speed, traffic = sizing.speed, sizing.traffic
        figures = (actors.cores, speed, speed * config.replay.ratio)
        streams = (speed * traffic.inserts / 1e6, speed * traffic.draws / 1e6, speed * traffic.weights / 1e6)
        delivered = f"{sizing.weights_delivered:.0%}"
        memory = f"{(replay.memory + learner.memory) / 2**30:,.1f} GiB"
        numbers = [f"{value:,.0f}" for value in figures] + [f"{value:,.1f}" for value in streams]
        rows.append([*numbers, delivered, memory, sizing.bottleneck.name, f"{enough_actors(sizing):,}"])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
