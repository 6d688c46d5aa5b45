"""The parts of `gpu.py`, what a GPU makes of each: `gpu_parts.py NAME --out FOLDER`, whose figures are lines of JSON.

Each imports what it measures only when it runs, in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).parent


def main() -> None:
    """Run a part."""
    parser = argparse.ArgumentParser()
    parser.add_argument("part")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--case", nargs=2, metavar=("METHOD", "BATCH"), help="of the part updates")
    options = parser.parse_args()
    sys.path[:0] = [str(BENCHMARKS.parent), str(BENCHMARKS / "bench/subjects")]
    globals()[f"part_{options.part}"](options)


def figure(**row: Any) -> None:
    """A figure of a part."""
    print(json.dumps(row), flush=True)


def part_facts(options: argparse.Namespace) -> None:
    """What machine and versions these are."""
    import torch

    row = {"torch": torch.__version__, "cuda": torch.version.cuda, "cores": os.cpu_count(), "python": sys.version[:6]}
    if torch.cuda.is_available():
        row["gpu"] = torch.cuda.get_device_name()
        from coop.learner.edl import kernels

        row["kernels"] = kernels.usable(torch.ones(1, device="cuda"))
    figure(**row)


def part_accuracy(options: argparse.Namespace) -> None:
    """The error of T^T e + s P^T e, and of P^T e alone, of each layer against SVDs in float64."""
    import torch

    from coop.common.networks.network import FlatNetwork, build_network, sample_inputs
    from coop.common.types import EnvSpec
    from coop.learner.edl import kernels
    from coop.learner.edl.completed import Jacobians
    from coop.learner.edl.layers import make_backprop
    from coop.learner.edl.transforms import Transforms

    device, batch = torch.device(options.device), 4 if options.quick else 32
    for actions in (2, 6, 18):
        spec = EnvSpec("Atari", (84, 84), "uint8", 4, actions)
        error = torch.randn(batch, actions, generator=torch.Generator().manual_seed(0)).to(device)
        for name, tf32, dtype in (
            ("float32", False, torch.float32),
            ("TF32", True, torch.float32),
            ("bfloat16", False, torch.bfloat16),
        ):
            torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = tf32
            network = FlatNetwork(build_network("nature", spec, (), 0).to(device, dtype))
            exact = FlatNetwork(build_network("nature", spec, (), 0).double())
            x = sample_inputs(spec, batch)
            with torch.no_grad():
                chain = make_backprop(network.module, None)
                transforms = Transforms(chain, chain.forward(x.to(device, dtype)))
                found = transforms._jacobians().apply(error @ transforms._basis.T, 1.0)
                alone = [
                    Jacobians([t.double()], [None], transforms._basis.double(), batch).apply(
                        (error @ transforms._basis.T).double(), 1.0
                    )[0]
                    for t in transforms._ts
                ]
                chain = make_backprop(exact.module, None)
                wanted = Transforms(chain, chain.forward(x.double()))._ts
                for layer, (got, own, t) in enumerate(zip(found, alone, wanted, strict=True)):
                    u, _, vh = torch.linalg.svd(t, full_matrices=False)
                    e = (error.cpu().double() @ _host(transforms._basis).T)[:, None]
                    want = (e @ (t + u @ vh))[:, 0]
                    # The whole error, and that of the algebra on the T at hand.
                    row = {"actions": actions, "precision": name, "layer": 4 - layer}
                    errors = {"whole": _relative(got, want), "algebra": _relative(got, own)}
                    figure(what="error of feedback", **row, fused=kernels.fits(transforms._ts, batch), **errors)


def _host(array: Any) -> Any:
    return array.detach().cpu().double()


def _relative(got: Any, want: Any) -> float:
    got, want = _host(got), _host(want)
    return float(f"{float((got - want).norm() / want.norm()):.2e}")


def _config(method: str, batch: int, device: str, dtype: str = "float32", **learner: Any) -> Any:
    from work import update_config

    config = update_config("nature", method, batch, dtype, device)
    from dataclasses import replace

    return replace(config, learner=replace(config.learner, double=True, **learner))


def _rate(update: Callable[[], object], seconds: float, device: str, each: int = 1) -> float:
    import torch

    def wait() -> None:
        if device != "cpu":
            torch.cuda.synchronize()

    for _ in range(3):
        update()
    wait()
    count, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds or not count:
        for _ in range(20 if device != "cpu" else 1):
            update()
            count += each
        wait()
    return round(count / (time.perf_counter() - began), 1)


def drawn_updates(agent: Any, spec: Any, count: int, recorded: bool, branches: bool = True) -> Callable[[], object]:
    """Updates with batches drawn on the device: `count` of them with each call."""
    import torch

    from coop.learner.device_table import DeviceTable
    from coop.learner.recorded import captured, cuda_graph

    table = DeviceTable(spec, 10_000, 16, 3, 0.99, agent.device)
    table._obs.random_(0, 256)
    table._rewards.normal_()
    table._actions.random_(0, spec.num_actions)
    table.steps.fill_(10_000)
    s, rate = torch.tensor(0.1, device=agent.device), torch.tensor(1e-4, device=agent.device)

    def update() -> None:
        for _ in range(count):
            agent._learn(0, table.sample(agent.config.learner.batch_size, s, rate))

    if recorded and agent.device.type == "cuda":
        with torch.inference_mode():
            torch.backends.cudnn.benchmark = True
            if branches:
                return cuda_graph(update, agent.device)
            update()
            return captured(update, agent.device)

    def led() -> None:
        with torch.inference_mode():
            update()

    return led


def part_updates(options: argparse.Namespace) -> None:
    """Updates/s of the nature network with six actions, of one method and batch size."""
    from made_up import random_batch
    from work import ATARI

    from coop.common.process.limits import use_threads
    from coop.learner.agent import Agent

    use_threads(1)
    device, seconds = options.device, 0.1 if options.quick else 0.6
    method, batch = options.case[0], int(options.case[1])
    many, given = 8 if batch == 32 else 2, random_batch(ATARI, batch)
    main = method in ("dqn", "coop")
    for dtype, tf32 in (("float32", True), *([("bfloat16", True), ("float32", False)] if main else [])):
        precision = dtype if not tf32 or dtype != "float32" else "TF32"
        row = {"what": "updates/s", "method": method, "batch": batch, "precision": precision}
        with _kept(row):
            agent = Agent(_config(method, batch, device, dtype, tf32=tf32), ATARI)
            drawn = drawn_updates(agent, ATARI, many, True)
            figure(**row, way=f"drawn on the device, {many} a replay", value=_rate(drawn, seconds, device, many))
            if precision != "TF32":
                continue
            if main:
                drawn = drawn_updates(agent, ATARI, many, True, branches=False)
                way = f"drawn on the device, {many} a replay, no branches"
                figure(**row, way=way, value=_rate(drawn, seconds / 2, device, many))
            value = _rate(lambda: agent.update(given), seconds, device)
            figure(**row, way="batches of the host", value=value, eager=agent.eager)
            if method == "coop":
                drawn = drawn_updates(agent, ATARI, 1, False)
                figure(**row, way="eager, drawn on the device", value=_rate(drawn, seconds / 2, device))


@contextmanager
def _kept(row: dict[str, Any]) -> Iterator[None]:
    """Let what fails cost no more than itself."""
    try:
        yield
    except Exception as error:
        figure(**row, failed=f"{type(error).__name__}: {error}"[:300])
        import traceback

        traceback.print_exc()


def part_profile(options: argparse.Namespace) -> None:
    """Microseconds of each kernel in an update, in profile-METHOD-BATCH.txt; their sum and the longest here."""
    import torch
    from torch.profiler import ProfilerActivity, profile
    from work import ATARI

    from coop.learner.agent import Agent

    activities = [ProfilerActivity.CUDA if options.device != "cpu" else ProfilerActivity.CPU]
    lines: list[str] = []
    for method, batch in (("coop", 4),) if options.quick else (("dqn", 32), ("coop", 32), ("dqn", 512), ("coop", 512)):
        with _kept({"what": "profile", "method": method, "batch": batch}):
            agent = Agent(_config(method, batch, options.device), ATARI)
            update = drawn_updates(agent, ATARI, 2, True)
            for _ in range(3):
                update()
            with profile(activities=activities) as seen:
                for _ in range(5):
                    update()
                if options.device != "cpu":
                    torch.cuda.synchronize()
            events = seen.key_averages()
            micro = lambda event: getattr(event, "self_device_time_total", 0) or event.self_cpu_time_total  # noqa: E731
            ordered = sorted(events, key=micro, reverse=True)
            total, kernels = sum(map(micro, events)) / 10, sum(event.count for event in events) / 10
            figure(what="profile", method=method, batch=batch, microseconds=round(total, 1), kernels=kernels)
            lines.append(f"\n{method}, batch {batch}: {total:.1f} us and {kernels:.1f} kernels an update")
            lines += [f"{micro(e) / 10:9.2f} us  {e.count / 10:5.1f} x  {e.key[:150]}" for e in ordered[:60]]
        (options.out / "profile.txt").write_text("\n".join(lines))


def part_pieces(options: argparse.Namespace) -> None:
    """Microseconds of the pieces of an update, each recorded 20 times in a row and repeated."""
    import torch
    from work import ATARI

    from coop.learner.agent import Agent
    from coop.learner.device_table import DeviceTable
    from coop.learner.edl.transforms import Transforms
    from coop.learner.losses import output_error, td_errors
    from coop.learner.recorded import cuda_graph

    on_gpu, count = options.device != "cpu", 20 if options.device != "cpu" else 1
    for batch in (4,) if options.quick else (32, 512):
        agent = Agent(_config("coop", batch, options.device), ATARI)
        torch.backends.cudnn.benchmark = True
        online, target = agent._networks
        table = DeviceTable(ATARI, 10_000, 16, 3, 0.99, agent.device)
        table.steps.fill_(10_000)
        table._obs.random_(0, 256)
        s, rate = torch.tensor(0.1, device=agent.device), torch.tensor(1e-4, device=agent.device)
        with torch.inference_mode():
            given = table.sample(batch, s, rate)
            inputs = online.inputs(given.frames, given.index)
            tape = online.forward(inputs)
            head, next_values = tape.head(batch), target.values(inputs[batch:])

            def loss() -> Any:
                bootstrap = agent.rule.bootstrap(next_values, tape.output[batch:])
                errors = td_errors(given.columns, tape.output[:batch], bootstrap, None)
                return output_error(given.columns, agent.loss.slope(errors), next_values)

            error = loss()
            chain, out = online._passes.backprop, online._passes.gradients
            transforms = Transforms(chain, head)
            deltas = [(index, delta[:, 0].contiguous()) for index, delta in chain.cotangents(head, error[:, None])]
            sigmas = list(transforms.apply_feedback(error, s))
            pieces: dict[str, Callable[[], object]] = {
                "sample": lambda: table.sample(batch, s, rate),
                "inputs": lambda: online.inputs(given.frames, given.index),
                "forward of obs and next_obs": lambda: online.forward(inputs),
                "forward of the target": lambda: target.values(inputs[batch:]),
                "loss": loss,
                "backpropagation alone": lambda: list(chain.cotangents(head, error[:, None])),
                "gradients of parameters": lambda: [chain.write_gradients(head, i, d, out) for i, d in deltas],
                "gradients of parameters, EDL": lambda: [chain.write_gradients(head, i, d, out) for i, d in sigmas],
                "transforms": lambda: Transforms(chain, head),
                "feedback through transforms": lambda: list(transforms.apply_feedback(error, s)),
                "optimizer": lambda: agent.optimizers[0].step(rate),
            }
            for index, delta in deltas:
                pieces[f"gradient of layer {chain.names[index]}"] = lambda i=index, d=delta: chain.write_gradients(
                    head, i, d, out
                )
            for name, piece in pieces.items():
                with _kept({"what": "microseconds", "piece": name, "batch": batch}):
                    many = lambda piece=piece: [piece() for _ in range(count)]  # noqa: E731
                    repeat = cuda_graph(many, agent.device) if on_gpu else many
                    value = round(1e6 / _rate(repeat, 0.05 if options.quick else 0.15, options.device, count), 1)
                    figure(what="microseconds", piece=name, batch=batch, value=value)


def part_jax(options: argparse.Namespace) -> None:
    """Updates/s of a jitted DQN in JAX: flax, optax, a scan over updates, batches drawn on the device."""
    import flax.linen as nn
    import jax
    import jax.numpy as jnp
    import optax

    class Nature(nn.Module):
        @nn.compact
        def __call__(self, x):
            x = x.astype(jnp.float32) / 255
            for features, kernel, stride in ((32, 8, 4), (64, 4, 2), (64, 3, 1)):
                x = nn.relu(nn.Conv(features, (kernel, kernel), (stride, stride), padding="VALID")(x))
            return nn.Dense(6)(nn.relu(nn.Dense(512)(x.reshape(x.shape[0], -1))))

    network, optimizer = Nature(), optax.adam(1e-4, eps=1.5e-4)
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    frames = jax.random.randint(keys[0], (10_000, 84, 84), 0, 256).astype(jnp.uint8)
    blank = jnp.zeros((1, 84, 84, 4))
    online, target = network.init(keys[1], blank), network.init(keys[2], blank)
    for batch in (4,) if options.quick else (32, 512):

        def update(state, key, batch=batch):
            parameters, moments = state
            drawn, acted, paid = jax.random.split(key, 3)
            index = jax.random.randint(drawn, (batch, 1), 0, 9_990) + jnp.arange(4)
            obs, next_obs = (frames[index + i].transpose(0, 2, 3, 1) for i in (0, 1))
            actions, rewards = jax.random.randint(acted, (batch, 1), 0, 6), jax.random.normal(paid, (batch,))
            best = network.apply(parameters, next_obs).argmax(1)[:, None]
            goal = rewards + 0.99 * jnp.take_along_axis(network.apply(target, next_obs), best, 1)[:, 0]

            def loss(parameters):
                values = jnp.take_along_axis(network.apply(parameters, obs), actions, 1)[:, 0]
                return optax.huber_loss(values, goal).mean()

            updates, moments = optimizer.update(jax.grad(loss)(parameters), moments, parameters)
            return (optax.apply_updates(parameters, updates), moments), 0.0

        count = 2 if options.quick else 200
        many = jax.jit(lambda state, key: jax.lax.scan(update, state, jax.random.split(key, count))[0])
        state = jax.block_until_ready(many((online, optimizer.init(online)), keys[0]))
        done, began = 0, time.perf_counter()
        while time.perf_counter() - began < (0.1 if options.quick else 1.5):
            state = jax.block_until_ready(many(state, keys[done % 3]))
            done += 1
        taken = time.perf_counter() - began
        row = {"what": "updates/s", "method": "JAX dqn", "batch": batch, "device": str(jax.devices()[0])}
        figure(**row, way="drawn on the device, a scan", value=round(done * count / taken, 1))


def part_sb3(options: argparse.Namespace) -> None:
    """Updates/s of Stable-Baselines3's DQN, from its own buffer."""
    import gymnasium
    import numpy as np
    from stable_baselines3 import DQN
    from stable_baselines3.common.logger import Logger

    class Spaces(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 255, (4, 84, 84), np.uint8)
        action_space = gymnasium.spaces.Discrete(6)

    for batch in (4,) if options.quick else (32, 512):
        model = DQN("CnnPolicy", Spaces(), buffer_size=1024, batch_size=batch, device=options.device, seed=0)
        model.set_logger(Logger(None, []))
        rng = np.random.default_rng(0)
        for _ in range(1024):
            obs, next_obs = rng.integers(0, 256, (2, 1, 4, 84, 84)).astype(np.uint8)
            model.replay_buffer.add(obs, next_obs, np.array([rng.integers(6)]), np.zeros(1), np.zeros(1), [{}])
        update = lambda: model.train(gradient_steps=1, batch_size=batch)  # noqa: E731
        row = {"what": "updates/s", "method": "Stable-Baselines3", "batch": batch}
        figure(**row, way="batches of the host", value=_rate(update, 0.1 if options.quick else 2, options.device))


def part_acting(options: argparse.Namespace) -> None:
    """Decisions/s of the nature network for 64 emulators; steps/s of two groups of them, with it and without."""
    import numpy as np
    from work import ATARI

    from coop.actors.player import Player
    from coop.actors.policy import EpsilonGreedy
    from coop.common.envs.make import make_vector_env
    from coop.common.networks.acting import acting_network
    from coop.common.settings.config import NetworkSettings
    from coop.common.settings.tables import load_tables, resolve

    game, nature = resolve(load_tables("breakout", None) | {"methods": {}}, "dqn").env, NetworkSettings("nature")
    network = acting_network(nature, ATARI, options.device)
    obs = np.random.default_rng(0).integers(0, 256, (64, 4, 84, 84)).astype(np.uint8)
    rate = _rate(lambda: network.q_values(obs, ATARI).argmax(1), 0.2 if options.quick else 1.5, options.device, 64)
    figure(what="decisions/s", emulators=64, value=rate)
    each = 2 if options.quick else 32
    for greedy in (False, True, False, True, False, True):
        envs = [make_vector_env(game, each, group) for group in range(2)]
        acts = acting_network(nature, envs[0].spec, options.device)
        policy = EpsilonGreedy((acts, acts), envs[0].spec, np.random.default_rng(0))
        players = [Player(env, policy, lambda _, greedy=greedy: 0.05 if greedy else 1.0) for env in envs]
        for player in players:
            player.begin()
            player.send(0, 0)

        def turn(players: list[Player] = players) -> None:
            for player in players:
                player.recv()
                player.send(0, 0)

        rate = _rate(turn, 0.5 if options.quick else 2.0, "cpu", 2 * each)
        what = "steps/s, the network acts" if greedy else "steps/s, emulators alone"
        figure(what=what, emulators=2 * each, value=rate)
        for player, env in zip(players, envs, strict=True):
            player.recv()
            env.close()


def part_tests(options: argparse.Namespace) -> None:
    """The tests of a GPU, and those of recorded updates."""
    tests = ["tests/test_recorded.py"] if options.device == "cpu" else ["tests/test_cuda.py", "tests/test_recorded.py"]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x" if options.quick else "--maxfail=20",
        "-p",
        "no:cacheprovider",
    ]
    done = subprocess.run([*command, *tests], capture_output=True, text=True, check=False)
    (options.out / "tests.txt").write_text(done.stdout[-40_000:] + done.stderr[-10_000:])
    figure(what="tests", status=done.returncode, last=done.stdout.strip().splitlines()[-1] if done.stdout else "")
    for line in re.findall(r"^(?:FAILED|ERROR) .*", done.stdout, re.MULTILINE)[:12]:
        figure(what="tests", failed=line[:200])


def part_run(options: argparse.Namespace) -> None:
    """A whole run of Breakout over processes."""
    seconds = 20 if options.quick else 60
    actors = max(1, min(10, (os.cpu_count() or 2) - 4))
    with tempfile.TemporaryDirectory() as folder:
        flags = [
            "--preset",
            "breakout",
            "--method",
            "coop",
            "--learner.device",
            options.device,
            "--total-steps",
            "100000000",
        ]
        flags += ["--replay.learning-starts", "1000", "--replay.capacity", "10000", "--actors", str(actors)]
        if options.quick:
            flags += ["--network.kind", "nips2013"]
        command = [sys.executable, "-m", "coop.deploy.commands", "coop-local", *flags, "--run-dir", f"{folder}/run"]
        process = subprocess.Popen(command, stdout=sys.stderr, stderr=subprocess.STDOUT)
        busy, rows = [], []
        began = time.monotonic()
        metrics = Path(folder, "run", "metrics.jsonl")
        while time.monotonic() - began < seconds and process.poll() is None:
            time.sleep(1)
            if options.device != "cpu":
                busy.append(_busy())
        if metrics.exists():
            rows = [json.loads(line) for line in metrics.read_text().splitlines()]
        process.send_signal(2)
        try:
            process.wait(25)
        except subprocess.TimeoutExpired:
            process.kill()
        for log in sorted(Path(folder, "run", "logs").glob("*.log")):
            print(f"--- {log.name}", log.read_text(errors="replace")[-1500:], file=sys.stderr)
        later = rows[len(rows) // 2 :]
        mean = lambda name: round(sum(row[name] for row in later) / max(1, len(later)), 1)  # noqa: E731
        figure(
            what="run", rows=len(rows), actors=actors,
            **{name: mean(name) for name in ("updates_per_s", "env_steps_per_s", "weight_lag_mean") if later},
            gpu_busy=round(sum(busy[len(busy) // 2 :]) / len(busy[len(busy) // 2 :]), 1) if busy else None,
        )  # fmt: skip


def _busy() -> float:
    command = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits"]
    try:
        return float(subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.split()[0])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return float("nan")


if __name__ == "__main__":
    main()
