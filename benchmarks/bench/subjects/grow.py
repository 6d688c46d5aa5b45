"""What a part costs as its work grows: grow.py PART SIZE. Microseconds of each unit of work, and memory of all of it.

table: transitions of 4 floats held; a unit is one inserted and one drawn. emulators: of CartPole, acted for at once; a
unit is a step. actors: synthetic ones at a learner and a replay service; a unit is what a second of an actor takes of
the processor time of those two. length: steps of a lockstep run; a unit is a step. runs: in a report; a unit is a run.
actions: of the nature network; a unit is an update of coop, divided by them.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
from fan_in import measure
from learn import run
from made_up import random_batch, segments
from start import BIN, PACKED
from turns import attend, rate, resident_bytes
from work import ATARI, BATCH, KINDS, STEPS, update_config

from coop.actors.policy import EpsilonGreedy
from coop.common.envs.make import env_spec, make_vector_env
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.process.limits import use_threads
from coop.learner.agent import Agent
from coop.replay.table.table import Table
from coop.studies.report.packing import study_file

Turn = Callable[[float], tuple[float, float]]  # seconds of a unit, measured for about so many seconds; MiB of all of it
ROLES = ("learner", "replay")
RATE, PLAYED = 100.0, 10.0  # transitions/s of a synthetic actor; seconds


def table(size: int) -> Turn:
    before, spec = resident_bytes(), KINDS["mlp"][1]
    held, stream = Table(spec, size, rng=np.random.default_rng(0)), segments(spec, STEPS)
    while held.inserted < 1.2 * size:
        held.insert(next(stream))

    def unit() -> None:
        held.insert(next(stream))
        for _ in range(STEPS // BATCH):
            held.sample(BATCH)

    return lambda seconds: (1 / rate(unit, seconds, STEPS), _since(before))


def emulators(size: int) -> Turn:
    before, config = resident_bytes(), update_config("mlp", "coop", BATCH, "float32")
    spec, env = env_spec(config.env), make_vector_env(config.env, size, seed=0)
    networks = tuple(FlatNetwork(build_network("mlp", spec, config.network.hidden, seed)) for seed in (0, 1))
    policy, seen = EpsilonGreedy(networks, spec, np.random.default_rng(0)), [env.reset()]

    def unit() -> None:
        seen[0] = env.step(policy.act(seen[0], 0.1)).obs

    return lambda seconds: (1 / rate(unit, seconds, size), _since(before))


def actors(size: int) -> Turn:
    def turn(_: float) -> tuple[float, float]:
        options = argparse.Namespace(network="small", publish_every=10, processes=2, rate=RATE * size, seconds=PLAYED)
        row = measure(size, options)
        if row.problems:
            raise RuntimeError("; ".join(row.problems))
        cores, mebibytes = (sum(row.figures[f"{role}: {what}"] for role in ROLES) for what in ("cores", "MiB"))
        return cores / size, mebibytes

    return turn


def length(size: int) -> Turn:
    def turn(_: float) -> tuple[float, float]:
        with tempfile.TemporaryDirectory() as folder:
            summary = run("lockstep", "cartpole", 0, Path(folder), "--total-steps", str(size))
        return float(summary["wall_seconds"]) / size, _largest_child()

    return turn


def runs(size: int) -> Turn:
    folder = Path(tempfile.mkdtemp())
    (folder / "some.parquet").write_bytes(study_file(pq.read_table(PACKED).slice(0, size)))

    def turn(_: float) -> tuple[float, float]:
        begun = time.monotonic()
        command = [BIN / "coop-report", folder / "some.parquet", "--out", folder / "report"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return (time.monotonic() - begun) / size, _largest_child()

    return turn


def actions(size: int) -> Turn:
    before, spec = resident_bytes(), msgspec.structs.replace(ATARI, num_actions=size)
    agent, batch = Agent(update_config("nature", "coop", BATCH, "float32"), spec), random_batch(spec, BATCH)
    return lambda seconds: (1 / rate(partial(agent.update, batch), seconds, size), _since(before))


def _since(before: int) -> float:
    """MiB by which this process has grown."""
    return (resident_bytes() - before) / 2**20


def _largest_child() -> float:
    """MiB of the largest process that this one has started."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**10


def main(part: str, size: int) -> None:
    use_threads(1)
    take = {
        "table": table,
        "emulators": emulators,
        "actors": actors,
        "length": length,
        "runs": runs,
        "actions": actions,
    }[part](size)

    def turn(seconds: float) -> dict[str, float]:
        cost, mebibytes = take(seconds)
        return {"us a unit": 1e6 * cost, "MiB": mebibytes}

    attend(turn)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
