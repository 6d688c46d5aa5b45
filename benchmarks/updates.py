"""Compares a learner process with updates on a constant batch and Stable-Baselines3: `python benchmarks/updates.py`.

The learner is a real `coop-learner` with the nature network, fed by a real `coop-replay` and broadcasting to a
subscriber. A signal stops it while the others, in their own process, take their turns: `Agent.update` on one
batch in memory, and Stable-Baselines3's `DQN.train` with the same batch size and threads. Prints updates per second,
and updates per second of processor time of the training thread, which is valid on shared cores. Needs the
extra `bench`. `--core 1` reserves a core for the learner: the other processes stay off it.
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
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import torch
from table import ATARI, segments

from common.messaging.clients import InsertClient
from common.messaging.joining import join
from common.messaging.keys import replay_key
from common.messaging.messages.join import Join
from common.messaging.messages.stats import ReplayStats, StatsQuestion
from common.messaging.session import open_session
from common.messaging.transport import NoAnswer, Node, new_incarnation
from common.process.lifecycle import Stop
from common.process.memory import keep_freed_memory
from common.process.processes import ChildProcess, command, free_endpoint
from common.process.threads import use_threads
from common.settings.config import RunConfig
from common.settings.tables import load_tables, resolve, to_toml
from learner.agent import Agent
from replay.table.table import Table

RUN = "bench"
STEPS = 32
FILLED = 4096  # transitions before the measurements
Figures = tuple[float, float]  # updates per second, updates per second of processor time


def run_config(method: str, dtype: str, batch_size: int, device: str) -> RunConfig:
    """Breakout as Mnih et al. played it, with a limiter that admits everything."""
    tables = load_tables("breakout", None)
    tables["network"] |= {"dtype": dtype}
    tables["learner"] |= {"batch_size": batch_size, "device": device}
    tables["replay"] |= {"capacity": 10_000, "learning_starts": 1000, "tolerance": 1e12}
    return resolve({**tables, "run": RUN, "total_steps": 10**12}, method)


def bare(config: RunConfig, core: int | None, end: Connection) -> None:
    """Answers each ("constant" | "sb3", seconds) with its figures."""
    keep_off(core, own=True)
    use_threads(1)
    keep_freed_memory()
    table = Table(ATARI, 1024, rng=np.random.default_rng(0))
    table.insert(next(segments(ATARI, 1024)))
    agent, batch = Agent(config, ATARI), table.sample(config.learner.batch_size)
    turns = {"constant": lambda: agent.update(batch), "sb3": rival(config.learner.batch_size, config.learner.device)}
    for turn in turns.values():
        turn()
    while (work := end.recv()) is not None:
        what, seconds = work
        updates, begun, processor = 0, time.perf_counter(), time.thread_time()
        while (spent := time.perf_counter() - begun) < seconds:
            turns[what]()
            updates += 1
        end.send((updates / spent, updates / (time.thread_time() - processor)))


def rival(batch_size: int, device: str) -> Callable[[], None]:
    """One `DQN.train` step of Stable-Baselines3, with the same network and a filled buffer."""
    import gymnasium  # noqa: PLC0415
    from stable_baselines3 import DQN  # noqa: PLC0415
    from stable_baselines3.common.logger import Logger  # noqa: PLC0415

    class Pictures(gymnasium.Env):
        """An environment of which only the spaces matter."""

        observation_space = gymnasium.spaces.Box(0, 255, ATARI.obs_shape, np.uint8)
        action_space = gymnasium.spaces.Discrete(ATARI.num_actions)

    model = DQN("CnnPolicy", Pictures(), buffer_size=1024, batch_size=batch_size, device=device, seed=0)
    model.set_logger(Logger(None, []))
    rng = np.random.default_rng(0)
    for _ in range(256):
        obs, next_obs = rng.integers(0, 256, (2, 1, *ATARI.obs_shape)).astype(np.uint8)
        action, reward, done = rng.integers(0, ATARI.num_actions, 1), rng.random(1), np.zeros(1)
        model.replay_buffer.add(obs, next_obs, action, reward, done, [{}])
    return lambda: model.train(gradient_steps=1, batch_size=batch_size)


def keep_off(core: int | None, own: bool = False) -> None:
    """Keep this process, and those that it starts, off the learner's core, or only on it."""
    if core is not None:
        everything = set(range(os.cpu_count() or 1))
        os.sched_setaffinity(0, {core} if own else everything - {core})


class Topology:
    """A learner that is stopped between turns, a replay service, and this process, which inserts and subscribes."""

    def __init__(self, stack: ExitStack, config: RunConfig, core: int | None, folder: Path) -> None:
        head, replay = free_endpoint(), free_endpoint()
        settings = folder / "config.toml"
        settings.write_text(to_toml(config))
        flags = ["--config", str(settings), "--run-dir", str(folder / "run"), "--listen", head]
        pinned = [] if core is None else ["taskset", "-c", str(core)]
        log = stack.enter_context((folder / "learner.log").open("w"))
        self._learner = stack.enter_context(
            subprocess.Popen([*pinned, *command("coop-learner", *flags)], stdout=log, stderr=log)
        )
        stack.callback(self._learner.kill)
        joining = ["--run", RUN, "--connect", head, "--listen", replay, "--run-dir", str(folder)]
        service = ChildProcess("replay", command("coop-replay", *joining), folder / "replay.log")
        service.start()
        stack.callback(service.end, 10)
        stack.callback(service.interrupt)
        incarnation, stop = new_incarnation(), Stop()
        self._node = stack.enter_context(Node(open_session((), (head, replay)), RUN, "actor", incarnation))
        join(self._node, stop, Join("actor", incarnation, []), (head,), 60.0, need_replay=True)
        self._weights = self._node.latest(self._node.key("weights", "1"))
        self._inserts = InsertClient(self._node, stop, window=8)
        self._segments = segments(ATARI, STEPS)
        while self._drawn() is None:
            time.sleep(0.1)
        self._insert_up_to(FILLED)
        while not self._drawn():
            time.sleep(0.1)
        self._ratio = config.replay.ratio
        self._learner.send_signal(signal.SIGSTOP)

    def figures(self, seconds: float) -> Figures:
        """Measure the learner while this process inserts as many steps as the replay ratio requires."""
        self._learner.send_signal(signal.SIGCONT)
        time.sleep(0.3)
        first, begun, processor = self._drawn() or 0, time.perf_counter(), self._processor_seconds()
        while time.perf_counter() - begun < seconds:
            time.sleep(0.02)
            self._insert_up_to(FILLED + int((self._drawn() or 0) / self._ratio))
        updates, spent = (self._drawn() or 0) - first, time.perf_counter() - begun
        processor = self._processor_seconds() - processor
        self._learner.send_signal(signal.SIGSTOP)
        return updates / spent, updates / processor

    def _insert_up_to(self, transitions: int) -> None:
        while self._inserts.acked < transitions:
            self._inserts.submit(next(self._segments))

    def _drawn(self) -> int | None:
        question = StatsQuestion().encode(RUN)
        try:
            return ReplayStats.decode(self._node.ask(replay_key(self._node, "stats"), question)).drawn
        except NoAnswer:  # it has not begun to answer
            return None

    def _processor_seconds(self) -> float:
        """Processor time of the learner's main thread, in seconds."""
        pid = self._learner.pid
        return int(Path(f"/proc/{pid}/task/{pid}/schedstat").read_text().split()[0]) / 1e9


def measure(config: RunConfig, rounds: int, seconds: float, core: int | None) -> dict[str, list[Figures]]:
    """Figures of each round for a constant batch, Stable-Baselines3 and the learner."""
    figures: dict[str, list[Figures]] = {"constant": [], "sb3": [], "learner": []}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        spawn = multiprocessing.get_context("spawn")
        ours, theirs = spawn.Pipe()
        process = spawn.Process(target=bare, args=(config, core, theirs))
        process.start()
        stack.callback(process.join)
        stack.callback(ours.send, None)
        topology = Topology(stack, config, core, Path(folder))
        for _ in range(rounds):
            for what in ("constant", "sb3"):
                ours.send((what, seconds))
                figures[what].append(ours.recv())
            figures["learner"].append(topology.figures(seconds))
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("methods", nargs="*", default=["dqn", "coop"])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each measurement; a stop of 10 s cuts links")
    parser.add_argument("--dtype", default="float32", help="network.dtype; Stable-Baselines3 has float32 only")
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--device", default="cpu", help="of the updates, as PyTorch names it")
    parser.add_argument("--core", type=int, help="core of the learner and of those that it is compared with")
    options = parser.parse_args()
    try:
        torch.empty(0, device=options.device)
    except (RuntimeError, AssertionError) as error:
        parser.error(f"--device {options.device}: {str(error).splitlines()[0]}")
    keep_off(options.core)
    for method in options.methods:
        config = run_config(method, options.dtype, options.batch_size, options.device)
        figures = measure(config, options.rounds, options.seconds, options.core)
        print(
            f"{method}, batches of {options.batch_size}, {options.dtype} on {options.device}, {options.rounds} rounds "
            f"of {options.seconds:g} s: median (lowest to highest)"
        )
        for unit, place in (("updates/s", 0), ("updates/processor s", 1)):
            columns = {name: [pair[place] for pair in pairs] for name, pairs in figures.items()}
            for over, under in (("learner", "constant"), ("constant", "sb3")):
                ratios = [a / b for a, b in zip(columns[over], columns[under], strict=True)]
                columns[f"{over} / {under}"] = ratios
            for name, values in columns.items():
                digits = 2 if "/" in name else 0
                middle, low, high = (f"{x:,.{digits}f}" for x in (statistics.median(values), min(values), max(values)))
                print(f"  {unit:20} {name:20}{middle:>8} ({low} to {high})", flush=True)


if __name__ == "__main__":
    main()
