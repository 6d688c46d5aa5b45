"""The parts of `gpu.py`, what a GPU makes of each: `gpu_parts.py NAME --out FOLDER`, whose figures are lines of JSON.

Each imports what it measures only when it runs, in a process of its own.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gpu_rivals
import gpu_whole
from gpu_figures import figure, kept, per_second

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
    parts = {**globals(), **vars(gpu_rivals), **vars(gpu_whole)}
    try:
        parts[f"part_{options.part}"](options)
    except ModuleNotFoundError as error:  # of a rival: its figures are missing, the others' are not
        sys.exit(f"not installed: {error.name}")


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
        with kept(row):
            agent = Agent(_config(method, batch, device, dtype, tf32=tf32), ATARI)
            drawn = drawn_updates(agent, ATARI, many, True)
            figure(**row, way=f"drawn on the device, {many} a replay", value=per_second(drawn, seconds, device, many))
            if precision != "TF32":
                continue
            if main:
                drawn = drawn_updates(agent, ATARI, many, True, branches=False)
                way = f"drawn on the device, {many} a replay, no branches"
                figure(**row, way=way, value=per_second(drawn, seconds / 2, device, many))
            value = per_second(lambda: agent.update(given), seconds, device)
            figure(**row, way="batches of the host", value=value, eager=agent.eager)
            if method == "coop":
                drawn = drawn_updates(agent, ATARI, 1, False)
                figure(**row, way="eager, drawn on the device", value=per_second(drawn, seconds / 2, device))


def part_profile(options: argparse.Namespace) -> None:
    """Microseconds of each kernel in an update, in profile-METHOD-BATCH.txt; their sum and the longest here."""
    import torch
    from torch.profiler import ProfilerActivity, profile
    from work import ATARI

    from coop.learner.agent import Agent

    activities = [ProfilerActivity.CUDA if options.device != "cpu" else ProfilerActivity.CPU]
    lines: list[str] = []
    for method, batch in (("coop", 4),) if options.quick else (("dqn", 32), ("coop", 32), ("dqn", 512), ("coop", 512)):
        with kept({"what": "profile", "method": method, "batch": batch}):
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
                with kept({"what": "microseconds", "piece": name, "batch": batch}):
                    many = lambda piece=piece: [piece() for _ in range(count)]  # noqa: E731
                    repeat = cuda_graph(many, agent.device) if on_gpu else many
                    value = round(1e6 / per_second(repeat, 0.05 if options.quick else 0.15, options.device, count), 1)
                    figure(what="microseconds", piece=name, batch=batch, value=value)


if __name__ == "__main__":
    main()
