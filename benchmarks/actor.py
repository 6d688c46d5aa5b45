"""Compares an actor process with a bare loop of the same emulators and network: `python benchmarks/actor.py`.

The actor is a real `coop-actor` that inserts into a real `coop-replay`; a signal stops it while the bare loop, in its
own process, takes its turn: emulation alone, inference alone, then both, and both in two processes at once.
Ratios are taken in each round, so that they hold on a busy machine, both of wall time and of the processor time of all
threads of the process. Prints medians with their range.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import statistics
import subprocess
import tempfile
import time
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from actors.policy import Policy
from common.envs.make import env_spec, make_vector_env
from common.messaging.keys import replay_key
from common.messaging.messages.stats import ReplayStats, StatsQuestion
from common.messaging.session import open_session
from common.messaging.transport import NoAnswer, Node, new_incarnation
from common.networks.network import FlatNetwork, build_network
from common.process.processes import ChildProcess, command, free_endpoint
from common.process.threads import use_threads
from common.settings.config import RunConfig
from common.settings.tables import load_tables, resolve
from learner.agent import Agent
from learner.broadcast import Broadcaster
from learner.join_service import JoinService
from learner.roster import Roster
from learner.shared_epochs import SharedEpochs

EPSILON = 0.1
RUN = "bench"
LOOK_EVERY = 0.02  # seconds; each request for the replay service's count costs the topology a little processor time


class Figures(NamedTuple):
    """Seconds per step, in all, in the emulators and in the network; processor seconds per step."""

    step: float
    emulation: float
    inference: float
    processor: float


def run_config(envs: int, dtype: str) -> RunConfig:
    """Breakout as Mnih et al. played it late in a run, with a limiter that admits everything."""
    tables = load_tables("breakout", None)
    tables["replay"] |= {"capacity": 20_000, "learning_starts": 1000, "tolerance": 1e12}
    tables["actor"] |= {"envs": envs, "epsilon_start": EPSILON, "epsilon_final": EPSILON}
    tables["network"] |= {"dtype": dtype}
    return resolve({**tables, "run": RUN, "total_steps": 10**12})


def bare(config: RunConfig, end: Connection) -> None:
    """Answers each (what, seconds) with its figures: of "emulation", of "inference" or of "both" in a loop."""
    use_threads(1)
    spec, envs = env_spec(config.env), config.actor.envs
    env = make_vector_env(config.env, envs, seed=0)
    dtype = torch.bfloat16 if config.network.dtype == "bfloat16" else torch.float32
    first, second = (FlatNetwork(build_network(config.network.kind, spec, (), seed).to(dtype)) for seed in (0, 1))
    policy = Policy((first, second), spec, np.random.default_rng(0))
    obs = env.reset()
    actions = policy.act(obs, EPSILON)
    while (work := end.recv()) is not None:
        what, seconds = work
        steps, emulation, inference = 0, 0.0, 0.0
        begun, processor = time.perf_counter(), time.process_time()
        now = begun
        while now - begun < seconds:
            if what != "emulation":
                actions = policy.act(obs, EPSILON)
            acted = time.perf_counter()
            inference += acted - now
            if what != "inference":
                obs = env.step(actions).obs
            now = time.perf_counter()
            emulation += now - acted
            steps += envs
        spent = (now - begun, emulation, inference, time.process_time() - processor)
        end.send(Figures(*(value / steps for value in spent)))


class BareLoops:
    """Two processes of `bare`."""

    def __init__(self, stack: ExitStack, config: RunConfig) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._ends: list[Connection] = []
        for _ in range(2):
            ours, theirs = spawn.Pipe()
            process = spawn.Process(target=bare, args=(config, theirs))
            process.start()
            stack.callback(process.join)
            stack.callback(ours.send, None)
            self._ends.append(ours)

    def figures(self, what: str, seconds: float, processes: int = 1) -> list[Figures]:
        """Of so many of them at once."""
        ends = self._ends[:processes]
        for end in ends:
            end.send((what, seconds))
        return [end.recv() for end in ends]


class Topology:
    """A learner that does not train (this process), a replay service, and one actor that is stopped between turns."""

    def __init__(self, stack: ExitStack, config: RunConfig, folder: Path) -> None:
        head, replay = free_endpoint(), free_endpoint()
        spec = env_spec(config.env)
        session = open_session((head,), (replay,))
        self._node = stack.enter_context(Node(session, RUN, "learner", new_incarnation()))
        agent = Agent(config, spec)
        digest, epochs = agent.networks[0].layout_digest(), SharedEpochs([], "benchmark")
        JoinService(self._node, config, spec, digest, 0, epochs, Roster(), print)
        Broadcaster(self._node, agent)
        joining = ["--run", RUN, "--connect", head]
        service = command("coop-replay", *joining, "--listen", replay, "--run-dir", str(folder))
        child = ChildProcess("replay", service, folder / "replay.log")
        child.start()
        stack.callback(child.end, 10)
        stack.callback(child.interrupt)
        self._actor = stack.enter_context(subprocess.Popen(command("coop-actor", *joining)))
        stack.callback(self._actor.kill)
        while not self._inserted():
            time.sleep(0.1)
        self._actor.send_signal(signal.SIGSTOP)

    def figures(self, seconds: float) -> tuple[float, float]:
        """Seconds and processor seconds per step that the actor inserts, measured between two changes of the count."""
        self._actor.send_signal(signal.SIGCONT)
        changes = [(time.perf_counter(), self._processor_seconds(), self._inserted())]
        while len(changes) < 4 or changes[-1][0] - changes[0][0] < seconds:
            time.sleep(LOOK_EVERY)
            if (count := self._inserted()) != changes[-1][2]:
                changes.append((time.perf_counter(), self._processor_seconds(), count))
        self._actor.send_signal(signal.SIGSTOP)
        # The first turn after the stop is incomplete.
        seconds, processor, steps = (last - first for first, last in zip(changes[1], changes[-1], strict=True))
        return seconds / steps, processor / steps

    def _processor_seconds(self) -> float:
        fields = Path(f"/proc/{self._actor.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def _inserted(self) -> int:
        question = StatsQuestion().encode(RUN)
        try:
            return ReplayStats.decode(self._node.ask(replay_key(self._node, "stats"), question)).inserted
        except NoAnswer:  # it has not begun to answer
            return 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement; a stop of 10 s cuts links")
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--dtype", default="float32", help="network.dtype")
    options = parser.parse_args()
    config = run_config(options.envs, options.dtype)
    figures: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        loops = BareLoops(stack, config)
        topology = Topology(stack, config, Path(folder))
        for _ in range(options.rounds):
            alone = (loops.figures(what, options.seconds)[0] for what in ("emulation", "inference", "both"))
            emulation, inference, both = alone
            two = loops.figures("both", options.seconds, processes=2)
            actor, actor_processor = topology.figures(options.seconds)
            measured = {
                "emulation: steps/s": 1 / emulation.step,
                "inference: steps/s": 1 / inference.step,
                "both: steps/s": 1 / both.step,
                "actor: steps/s": 1 / actor,
                "time of both / of actor": both.step / actor,
                "processor time of both / of actor": both.processor / actor_processor,
                "time of both / of emulation + inference in it": both.step / (both.emulation + both.inference),
                "time of both / of emulation + inference alone": both.step / (emulation.step + inference.step),
                "  emulation in both / alone": both.emulation / emulation.step,
                "  inference in both / alone": both.inference / inference.step,
                "processor time of the same": both.processor / (emulation.processor + inference.processor),
                "speed of two processes / of one": sum(1 / loop.step for loop in two) * both.step,
            }
            for name, value in measured.items():
                figures.setdefault(name, []).append(value)
    print(f"{options.envs} emulators, {options.rounds} rounds of {options.seconds:g} s: median (lowest to highest)")
    for name, values in figures.items():
        digits = 0 if "steps/s" in name else 3
        middle, low, high = (f"{x:,.{digits}f}" for x in (statistics.median(values), min(values), max(values)))
        print(f"  {name:47}{middle:>9} ({low} to {high})")


if __name__ == "__main__":
    main()
