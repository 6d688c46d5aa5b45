"""Four methods learn one Atari game on one GPU, in turn, in one process: `make gpu-atari MINUTES=8 OUT=runs/gpu-atari`.

The emulators' frames go into a table on the GPU, from which recorded updates draw: 10,000 transitions, an update every
four steps, s = 0.1. Each method plays for a slice of time, saves itself in the folder, and the next one goes on. The
same command resumes from the folder, elsewhere too: networks and running means of squares are kept (61 MB at most, no
file above 11 MB), the table and the emulators start over, and a copied target is copied again.

    gpu_atari.py --out FOLDER [--minutes 8] [--game pong] [--device cuda] [--emulators 32] [--slice 20]
                 [--methods dqn ...] [--kind nature] [--starts 2000] [--seed 0]

--minutes 0 only writes the table and, with matplotlib, the figure anew.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import gpu

METHODS = ("dqn", "edql", "g-coop", "coop")
MARGIN = 4.0  # seconds to save and draw in
SIZE = 10_000
RATIO = 4  # steps of an update


def main() -> None:
    """Run in an environment in which everything is installed."""
    options = _options()
    options.out.mkdir(parents=True, exist_ok=True)
    for kept in options.out.glob("*.json"):
        had = json.loads(kept.read_text())
        if (had["game"], had["kind"]) != (options.game, options.kind):
            options.parser.error(f"--out: {kept} is of {had['game']} and {had['kind']}")
    if not options.inside:
        command = [sys.executable, __file__, "--inside", *sys.argv[1:]]
        raise SystemExit(subprocess.run(command, env=gpu.prepared(), check=False).returncode)
    sys.path.insert(0, str(gpu.ROOT))
    from coop.common.errors import CoopError

    if options.minutes > 0:
        try:
            learn(options)
        except CoopError as error:
            sys.exit(f"gpu_atari: error: {error}")
    print(table(options.out, options.methods))
    draw(options)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--game", default="pong")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--emulators", type=int, default=32)
    parser.add_argument("--slice", type=float, default=20.0, help="seconds")
    parser.add_argument("--least", type=int, default=32, help="steps of a slice")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    parser.add_argument("--kind", default="nature")
    parser.add_argument("--starts", type=int, default=2000, help="transitions before the first update")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.parser = parser
    each, rest = divmod(options.emulators, RATIO)
    if rest or not each or 1000 % each:
        parser.error(f"--emulators: {options.emulators} is not allowed; four times a divisor of 1,000, such as 32")
    return options


def learn(options: argparse.Namespace) -> None:
    """Let the methods play in turn until the time is up."""
    until = time.monotonic() + 60 * options.minutes - min(MARGIN, 6 * options.minutes)
    runs = [Run(options, method) for method in options.methods]
    try:
        over = False
        while not over:
            for place, run in enumerate(runs):
                share = (until - time.monotonic()) / (len(runs) - place)
                print(json.dumps(run.play(min(options.slice, share), options.least)), flush=True)
                run.save()
            over = time.monotonic() >= until
    except KeyboardInterrupt:
        print("stopped; the same command goes on behind the last whole slices")
    for run in runs:
        run.env.close()


class Run:
    """One method's run: its agent, emulators and table."""

    def __init__(self, options: argparse.Namespace, method: str) -> None:
        import torch

        from coop.common.process.limits import use_threads
        from coop.learner.agent import Agent
        from coop.learner.device_table import DeviceTable

        use_threads(1)
        self.method, self.out, self.starts = method, options.out, options.starts
        self.streams, self.each = options.emulators, options.emulators // RATIO
        self.config = settings(options, method)
        kept = options.out / f"{method}.json"
        what = {"game": options.game, "kind": options.kind}
        self.counts: dict[str, Any] = {**what, "steps": 0, "updates": 0, "episodes": 0, "seconds": 0.0, "resumed": 0}
        if kept.exists():
            self.counts = json.loads(kept.read_text())
            self.counts["resumed"] += 1
        seed = options.seed + 1000 * self.counts["resumed"]
        torch.manual_seed(seed)
        self.env = Emulators(self.config, self.streams, seed)
        self.agent = Agent(self.config, self.env.spec)
        if kept.exists():
            self.load()
        device = self.agent.device
        torch.backends.cudnn.benchmark = True  # shapes never change
        self.table = DeviceTable(self.env.spec, SIZE, self.streams, self.config.replay.n_step, 0.99, device)
        self.s = torch.full((), self.config.edl.rate if self.config.feedback != "none" else 0.0, device=device)
        self.rate = torch.full((), self.config.learner.learning_rate, device=device)
        self.epsilon = torch.ones((), device=device)
        self.repeats: dict[int, Any] = {}
        on_gpu = device.type == "cuda"
        shape, count = self.env.obs.shape, self.streams
        self.host_obs = torch.empty(shape, dtype=torch.uint8, pin_memory=on_gpu)
        self.host_outcomes = torch.empty(3, count, pin_memory=on_gpu)
        self.host_actions = torch.empty(count, dtype=torch.int64, pin_memory=on_gpu)
        self.last: deque[float] = deque(self.counts.get("last", ()), maxlen=100)
        self.begun = 0

    def play(self, seconds: float, least: int) -> dict[str, Any]:
        """Play for some time, and so many steps at least; returns a row of the curve, which is also kept."""
        import torch

        began, counts = time.perf_counter(), self.counts
        first = dict(counts)
        with torch.inference_mode():
            while time.perf_counter() - began < seconds or counts["steps"] - first["steps"] < least:
                self._step()
            self._wait()
        counts["seconds"] += time.perf_counter() - began
        taken = max(1e-9, counts["seconds"] - first["seconds"])
        row = {
            "method": self.method, **{name: counts[name] for name in ("steps", "updates", "episodes")},
            "seconds": round(counts["seconds"], 1),
            "return": round(sum(self.last) / len(self.last), 2) if self.last else None,
            "steps/s": round((counts["steps"] - first["steps"]) / taken),
            "updates/s": round((counts["updates"] - first["updates"]) / taken, 1),
        }  # fmt: skip
        with (self.out / f"{self.method}.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")
        return row

    def _step(self) -> None:
        """One action of every emulator; the updates it pays for run while it is played."""
        import torch

        agent, table, env, counts = self.agent, self.table, self.env, self.counts
        device = agent.device
        self.host_obs.copy_(torch.from_numpy(env.obs))
        self.host_outcomes.copy_(torch.from_numpy(env.outcomes))
        obs, outcomes = (one.to(device, non_blocking=True) for one in (self.host_obs, self.host_outcomes))
        table.show(obs, *outcomes)
        actor = self.config.actor
        at = min(1.0, counts["steps"] / actor.epsilon_steps)
        self.epsilon.fill_(actor.epsilon_start + at * (actor.epsilon_final - actor.epsilon_start))
        frames = obs.flatten(0, 1)
        index = torch.arange(len(frames), dtype=torch.int32, device=device)
        network = agent._networks[agent.acting]
        best = network.values(network.inputs(frames, index)).argmax(1)
        chance = torch.rand(2, self.streams, device=device)
        actions = torch.where(chance[0] < self.epsilon, (chance[1] * env.spec.num_actions).long(), best)
        table.act(actions)
        self.host_actions.copy_(actions, non_blocking=True)
        chosen = None
        if device.type == "cuda":
            chosen = torch.cuda.Event()
            chosen.record()
        self.begun += self.streams
        if self.begun >= self.starts:
            self._update()
        if chosen is not None:
            chosen.synchronize()
        returns = env.step(self.host_actions.numpy())
        self.last.extend(returns)
        counts["steps"] += self.streams
        counts["episodes"] += len(returns)

    def _update(self) -> None:
        """The updates of a step of all emulators: on a GPU one graph for each acting role."""
        from coop.learner.recorded import cuda_graph

        agent, acting = self.agent, self.agent.acting

        def updates() -> None:
            for _ in range(self.each):
                agent._learn(acting, self.table.sample(self.config.learner.batch_size, self.s, self.rate))

        if agent.device.type != "cuda":
            updates()
        else:
            if acting not in self.repeats:
                state = agent.state()
                self.repeats[acting] = cuda_graph(updates, agent.device)
                agent.load_state(state)
            self.repeats[acting]()
            agent.optimizers[acting].steps += self.each
        for _ in range(self.each):
            agent._count()
        self.counts["updates"] += self.each

    def _wait(self) -> None:
        import torch

        if self.agent.device.type == "cuda":
            torch.cuda.synchronize()

    def save(self) -> None:
        """Keep the trained networks with their running means of squares in bfloat16, and the counts."""
        import numpy as np
        import torch

        for number, optimizer in enumerate(self.agent.optimizers):
            square = optimizer.buffers["square"].to(torch.bfloat16).view(torch.int16).cpu().numpy()
            arrays = {"theta": self.agent.networks[number].flat.cpu().numpy(), "square": square}
            target = self.out / f"{self.method}-{number + 1}.npz"
            with target.with_suffix(".tmp").open("wb") as file:
                np.savez_compressed(file, **arrays)
            target.with_suffix(".tmp").replace(target)
        state = {
            **self.counts, "last": list(self.last), "acting": self.agent.acting, "agent_updates": self.agent.updates,
            "optimizer_steps": [optimizer.steps for optimizer in self.agent.optimizers],
        }  # fmt: skip
        target = self.out / f"{self.method}.json"
        target.with_suffix(".tmp").write_text(json.dumps(state))
        target.with_suffix(".tmp").replace(target)

    def load(self) -> None:
        """Go on from what `save` kept; running means of gradients begin at 0, a copied target as a copy."""
        import numpy as np
        import torch

        state = self.agent.state()
        for number in range(len(self.agent.optimizers)):
            with np.load(self.out / f"{self.method}-{number + 1}.npz") as kept:
                state["networks"][number] = torch.from_numpy(kept["theta"])
                square = torch.from_numpy(kept["square"]).view(torch.bfloat16).float()
            state["optimizers"][number] |= {"steps": self.counts["optimizer_steps"][number], "square": square}
        if len(self.agent.optimizers) == 1:
            state["networks"][1] = state["networks"][0]
        state |= {"acting": self.counts["acting"], "updates": self.counts["agent_updates"]}
        self.agent.load_state(state)


class Emulators:
    """Emulators that show the end of an episode, and begin the next one a step later.

    obs: uint8 [streams, 4, 84, 84]. outcomes: float32 [3, streams]: rewards for learning, terminated and truncated.
    """

    def __init__(self, config: Any, streams: int, seed: int) -> None:
        import numpy as np
        from gymnasium.vector import AutoresetMode

        from coop.common.envs.atari import _emulators, atari_spec
        from coop.common.envs.make import _atari_game

        game = _atari_game(config.env)
        self.spec = atari_spec(config.env, game)
        self._ale = _emulators(config.env, game, streams, stack_num=config.env.stack, autoreset=AutoresetMode.NEXT_STEP)
        seeds = np.random.SeedSequence(seed).generate_state(streams) & 0x7FFFFFFF
        self.obs, info = self._ale.reset(seed=seeds)
        self._start = info["frame_number"] - info["episode_frame_number"]
        self.outcomes = np.zeros((3, streams), np.float32)
        self._returns = np.zeros(streams)

    def step(self, actions: Any) -> list[float]:
        """Play an action in each, int64 [streams]; returns the scores of the games that have ended."""
        import numpy as np

        self._ale.send(actions.astype(np.int32))
        self.obs, rewards, terminated, truncated, info = self._ale.recv()
        start = info["frame_number"] - info["episode_frame_number"]
        restarted = start != self._start
        self._start = start
        over = self._returns[restarted].tolist()
        self._returns[restarted] = 0
        self._returns += rewards
        self.outcomes = np.stack((np.clip(rewards, -1, 1), terminated, truncated)).astype(np.float32)
        return over

    def close(self) -> None:
        """Join the emulators' threads."""
        del self._ale


def settings(options: argparse.Namespace, method: str) -> Any:
    """The preset's, but for the buffer, the optimizer, s, and the exploration of so short a run."""
    from coop.common.settings.tables import load_tables, resolve

    tables = load_tables("pong", None)
    tables.pop("methods", None)
    adam = {"optimizer": "adam", "learning_rate": 1e-4, "eps": 1.5e-4, "swap_every": 1000, "device": options.device}
    tables["env"]["id"], tables["network"]["kind"], tables["seed"] = options.game, options.kind, options.seed
    for name in ("alpha", "gradient_alpha"):
        tables["learner"].pop(name)
    tables["learner"] |= adam
    tables["edl"] = {"rate": 0.1}
    tables["replay"] |= {"capacity": SIZE, "learning_starts": options.starts, "n_step": 3}
    tables["actor"] |= {"epsilon_final": 0.01, "epsilon_steps": 100_000}
    return resolve(tables, method)


def table(folder: Path, methods: list[str]) -> str:
    """Where each method is."""
    lines = [f"{'method':8} {'steps':>10} {'updates':>9} {'minutes':>8} {'steps/s':>8} {'updates/s':>9} {'return':>8}"]
    for method in methods:
        if rows := curve(folder, method):
            row, seconds = rows[-1], max(1e-9, rows[-1]["seconds"])
            shown = "-" if row["return"] is None else f"{row['return']:.2f}"
            lines.append(
                f"{method:8} {row['steps']:10,} {row['updates']:9,} {seconds / 60:8.1f} "
                f"{row['steps'] / seconds:8,.0f} {row['updates'] / seconds:9,.1f} {shown:>8}"
            )
    lines.append("return: mean of the last 100 games of training")
    (folder / "table.txt").write_text("\n".join(lines) + "\n")
    return "\n".join(lines)


def curve(folder: Path, method: str) -> list[dict[str, Any]]:
    """The rows of a method's slices."""
    path = folder / f"{method}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def draw(options: argparse.Namespace) -> None:
    """Returns by steps and by minutes, in curves.png."""
    try:
        import matplotlib as mpl
    except ImportError:
        print("no figure without matplotlib; where it is: --minutes 0")
        return
    mpl.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.2), sharey=True, layout="constrained")
    for method in options.methods:
        rows = [row for row in curve(options.out, method) if row["return"] is not None]
        for axis, values in zip(axes, (("steps", 1e6), ("seconds", 60)), strict=True):
            axis.plot([row[values[0]] / values[1] for row in rows], [row["return"] for row in rows], label=method)
    for axis, name in zip(axes, ("million steps", "minutes"), strict=True):
        axis.set_xlabel(name)
    axes[0].set_ylabel(f"{options.game}, mean of 100 games")
    axes[0].legend()
    figure.savefig(options.out / "curves.png", dpi=120)


if __name__ == "__main__":
    main()
