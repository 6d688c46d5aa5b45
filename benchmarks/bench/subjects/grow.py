"""What a part costs as its work grows: grow.py PART SIZE. Microseconds of each unit of work, and memory of all of it.

table: transitions of 4 floats held; a unit is one inserted and one drawn. emulators: of CartPole, acted for at once; a
unit is a step. length: steps of a lockstep run; a unit is a step. runs: in a report; a unit is a run. actions: of the
nature network; a unit is an update of coop, divided by them.
"""

from __future__ import annotations

import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from learn import run
from made_up import random_batch, segments
from start import BIN, PACKED
from turns import attend, rate, resident_bytes
from work import ATARI, BATCH, KINDS, STEPS, update_config

from actors.policy import Policy
from common.envs.make import env_spec, make_vector_env
from common.networks.network import FlatNetwork, build_network
from common.process.threads import use_threads
from learner.agent import Agent
from replay.table.table import Table

Cost = Callable[[float], float]  # seconds of a unit, measured for about so many seconds


def table(size: int) -> Cost:
    spec = KINDS["mlp"][1]
    held, stream = Table(spec, size, rng=np.random.default_rng(0)), segments(spec, STEPS)
    while held.inserted < 1.2 * size:
        held.insert(next(stream))

    def unit() -> None:
        held.insert(next(stream))
        for _ in range(STEPS // BATCH):
            held.sample(BATCH)

    return lambda seconds: 1 / rate(unit, seconds, STEPS)


def emulators(size: int) -> Cost:
    config = update_config("mlp", "coop", BATCH, "float32")
    spec, env = env_spec(config.env), make_vector_env(config.env, size, seed=0)
    networks = tuple(FlatNetwork(build_network("mlp", spec, config.network.hidden, seed)) for seed in (0, 1))
    policy, seen = Policy(networks, spec, np.random.default_rng(0)), [env.reset()]

    def unit() -> None:
        seen[0] = env.step(policy.act(seen[0], 0.1)).obs

    return lambda seconds: 1 / rate(unit, seconds, size)


def length(size: int) -> Cost:
    def cost(_: float) -> float:
        with tempfile.TemporaryDirectory() as folder:
            return (
                float(run("lockstep", "cartpole", 0, Path(folder), "--total-steps", str(size))["wall_seconds"]) / size
            )

    return cost


def runs(size: int) -> Cost:
    folder = Path(tempfile.mkdtemp())
    subprocess.run([BIN / "coop-report", PACKED, "--unpack", folder / "all"], check=True, stdout=subprocess.DEVNULL)
    chosen = sorted(path.parent for path in (folder / "all").rglob("config.toml"))[:size]
    for path in chosen:
        shutil.copytree(path, folder / "some" / path.name)
    subprocess.run([BIN / "coop-report", folder / "some", "--pack", folder / "some.parquet"], check=True)

    def cost(_: float) -> float:
        begun = time.monotonic()
        command = [BIN / "coop-report", folder / "some.parquet", "--out", folder / "report"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return (time.monotonic() - begun) / size

    return cost


def actions(size: int) -> Cost:
    spec = msgspec.structs.replace(ATARI, num_actions=size)
    agent, batch = Agent(update_config("nature", "coop", BATCH, "float32"), spec), random_batch(spec, BATCH)
    return lambda seconds: 1 / rate(partial(agent.update, batch), seconds, size)


def main(part: str, size: int) -> None:
    use_threads(1)
    before = resident_bytes()
    cost = {"table": table, "emulators": emulators, "length": length, "runs": runs, "actions": actions}[part](size)

    def turn(seconds: float) -> dict[str, float]:
        microseconds = 1e6 * cost(seconds)
        children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**10  # of the largest one
        memory = children if part in ("length", "runs") else (resident_bytes() - before) / 2**20
        return {"us a unit": microseconds, "MiB": memory}

    attend(turn)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
