"""The dissection of error-driven learning: which part of it does what, by optimizer and depth, on CartPole.

    python -m results.cartpole.edl.dissect --out runs/dissect --device cuda --minutes 6

Conditions x optimizers x depths, each cell with the learning rate that the tuning chose for it. It goes on where it
stopped: every stack of runs is a file in --out. The rules are those of
results/cartpole/edl/plan.md.
"""

from __future__ import annotations

import argparse
import gc
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from coop.common.numbers import running_mean
from coop.studies.stacked.settings import OPTIMIZERS, Runs, StackSettings
from coop.studies.stacked.stack import Episodes, Stack
from results.cartpole.edl.layers import NAMES, measure

S = 0.1
CONDITIONS: dict[str, dict[str, Any]] = {
    "none": {"method": "dqn", "feedback": "none"},
    "transform": {"method": "edql", "feedback": "transform"},
    "matched": {"method": "dqn", "feedback": "matched"},
    "noise": {"method": "dqn", "feedback": "noise"},
    "transform-normal": {"method": "edql", "feedback": "transform", "noise": "normal"},
    "random": {"method": "edql", "feedback": "random"},
    "weight-gradient": {"method": "edql", "feedback": "weight-gradient"},
}
RATES = {
    "sgd": (3e-4, 1e-3, 3e-3, 1e-2, 3e-2),
    "rmsprop": (3e-5, 1e-4, 3e-4, 1e-3, 3e-3),
    "adam": (3e-5, 1e-4, 3e-4, 1e-3, 3e-3),
}
TUNING_SEEDS = 1000  # the first of them
FINAL = 0.93  # the learning rate is multiplied by this every 1,000 steps, as in the preset cartpole-paper
SLOW = "weight-gradient"  # its decompositions keep to the CPU: a seed a stack, at the rates of "none", not tuned
POINTS = 20  # measurements of a run
WAVE = 132  # runs that a GPU's processors play at once: one on each of an H100's
MEASURED, SPARE, OVERHEAD = 300, 1.2, 2.0  # steps; and of a stack's time: a factor, and seconds besides
AGREE = 1e-2  # of the way that parameters have come: a condition whose kernels are farther off runs without them
RATE_FILE = "rates.json"
PLAN = Path("results/cartpole/edl/plan.md")

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """What runs: of each depth, the seeds of its cells; and the sizes of a run."""

    out: Path
    device: str
    depths: tuple[int, ...]
    seeds: tuple[int, ...]
    tuning_seeds: int
    steps: int
    width: int
    conditions: tuple[str, ...]
    precision: str
    slow_seeds: int = 20
    workers: int = 0
    without_kernels: tuple[str, ...] = ()

    def settings(self, condition: str, depth: int) -> StackSettings:
        """The settings of a condition's runs: preset cartpole-paper with one optimizer for all and a constant s."""
        return StackSettings(
            **CONDITIONS[condition], hidden=depth, width=self.width, total_steps=self.steps,
            learning_rate_final=FINAL ** (self.steps / 1000), learning_starts=min(128, self.steps // 10),
        )  # fmt: skip

    def tuning(self) -> Runs:
        """Every rate of every optimizer, with each tuning seed."""
        seeds = range(TUNING_SEEDS, TUNING_SEEDS + self.tuning_seeds)
        cells = [(rate, seed) for name in OPTIMIZERS for rate, seed in product(RATES[name], seeds)]
        return _runs(cells, [(name, len(RATES[name]) * len(seeds)) for name in OPTIMIZERS])

    def study(self, seeds: Sequence[int], rates: dict[str, float]) -> Runs:
        """The seeds with each optimizer at its rate."""
        cells = [(rates[name], seed) for name in OPTIMIZERS for seed in seeds]
        return _runs(cells, [(name, len(seeds)) for name in OPTIMIZERS])


def _runs(cells: Sequence[tuple[float, int]], optimizers: Sequence[tuple[str, int]]) -> Runs:
    rates, seeds = (np.array(column) for column in zip(*cells, strict=True))
    return Runs(seeds, rates, np.full(len(seeds), S), tuple(optimizers))


def area(episodes: Episodes, steps: int) -> float:
    """The mean over environment steps of the running mean of 100 episodes, as `coop-report` has it."""
    if not len(episodes.returns):
        return float(steps)
    lengths = np.diff(episodes.env_step, prepend=0)
    latest = np.concatenate((episodes.returns[:1], running_mean(episodes.returns)[:-1]))
    return float(np.average(latest, weights=lengths))


def chosen(areas: Floats, common: int | None) -> int:
    """The index of a cell's rate, from the areas [rates, seeds] of its tuning.

    The rate with the largest mean; but `common`, that of the plain gradient with this optimizer and depth, unless the
    best one's lead over it, paired by seed, is more than one standard error.
    """
    best = int(areas.mean(1).argmax())
    if common is None or best == common:
        return best
    lead = areas[best] - areas[common]
    error = lead.std(ddof=1) / len(lead) ** 0.5 if len(lead) > 1 else 0.0
    return best if lead.mean() > error else common


def play(plan: Plan, condition: str, depth: int, runs: Runs, path: Path, deadline: float) -> dict[str, Any] | None:
    """Play a stack of runs and write it to `path`; None if the deadline comes first."""
    began = time.monotonic()
    settings = plan.settings(condition, depth)
    kernels = condition not in plan.without_kernels
    stack = Stack(settings, runs, plan.device, kernels=kernels, precision=plan.precision)
    every = max(1, settings.updates // POINTS // settings.swap_every) * settings.swap_every
    points, found = [], []
    stack.advance(settings.learning_starts)
    while stack.step < plan.steps:
        stack.advance(min(every, plan.steps - stack.step))
        if stack.updates % every == 0:
            points.append(stack.step)
            found.append(measure(stack).cpu().numpy())
        if time.monotonic() > deadline:
            return None
    episodes = stack.episodes()
    seconds = time.monotonic() - began
    names = np.concatenate([[name] * count for name, count in runs.optimizers])
    areas = np.array([area(each, plan.steps) for each in episodes])
    about = {
        "condition": condition, "depth": depth, "steps": plan.steps, "width": plan.width, "s": S, "seconds": seconds,
        "path": stack.path, "device": _device(plan.device), "torch": torch.__version__, "names": NAMES,
    }  # fmt: skip
    _write(
        path,
        about=np.array(json.dumps(about)),
        optimizer=names,
        seed=runs.seeds,
        rate=runs.rates,
        area=areas,
        finite=stack.finite(),
        counts=np.array([len(each.returns) for each in episodes]),
        env_step=np.concatenate([each.env_step for each in episodes]).astype(np.int32),
        returns=np.concatenate([each.returns for each in episodes]).astype(np.int16),
        points=np.array(points),
        measures=np.stack(found) if found else np.empty(0),
    )
    rate = len(runs.seeds) * plan.steps / seconds
    means = {name: round(float(areas[names == name].mean()), 1) for name in OPTIMIZERS}
    print(f"{path.stem}: {len(runs.seeds)} runs, {seconds:.1f} s, {rate:,.0f} steps/s, mean area {means}", flush=True)
    return {"area": areas, "optimizer": names, "rate": runs.rates}


def _write(path: Path, **arrays: Any) -> None:  # noqa: ANN401
    part = path.with_suffix(".part.npz")
    np.savez_compressed(part, **arrays)
    part.replace(path)


def _device(device: str) -> str:
    return torch.cuda.get_device_name() if device == "cuda" else "cpu"


def choose(plan: Plan, condition: str, depth: int, tuned: dict[str, Any]) -> None:
    """Add the cells' rates to rates.json, with what they were chosen from; "none" of the depth must be there first."""
    file = plan.out / RATE_FILE
    known = json.loads(file.read_text()) if file.exists() else {}
    for name in OPTIMIZERS:
        areas = tuned["area"][tuned["optimizer"] == name].reshape(len(RATES[name]), -1)
        common = None if condition == "none" else RATES[name].index(known[f"{depth} none {name}"]["rate"])
        index = chosen(areas, common)
        known[f"{depth} {condition} {name}"] = {
            "rate": RATES[name][index],
            "best": RATES[name][int(areas.mean(1).argmax())],
            "areas": dict(zip(map(str, RATES[name]), areas.mean(1).round(2).tolist(), strict=True)),
        }
    part = file.with_suffix(".part")
    part.write_text(json.dumps(known, indent=1))
    part.replace(file)


def known_rates(plan: Plan, condition: str, depth: int) -> dict[str, float]:
    """The rate of each optimizer that the tuning chose; empty if it has not."""
    file = plan.out / RATE_FILE
    known = json.loads(file.read_text()) if file.exists() else {}
    keys = {name: f"{depth} {condition} {name}" for name in OPTIMIZERS}
    return {name: known[key]["rate"] for name, key in keys.items()} if set(keys.values()) <= set(known) else {}


def run(plan: Plan, deadline: float) -> int:
    """Play what is not there yet, the tuning of a depth before its study; return how many stacks are left."""
    plan.out.mkdir(parents=True, exist_ok=True)
    left = 0
    longest: dict[tuple[int, str], float] = {}  # seconds of a stack by depth and phase
    workers: list[subprocess.Popen[bytes]] = []
    quick = [name for name in plan.conditions if name != SLOW]
    for depth, phase, condition in product(plan.depths, ("tuning", "study"), quick):
        if plan.workers and not workers and SLOW in plan.conditions and known_rates(plan, "none", plan.depths[0]):
            workers = [_worker(plan, number, deadline) for number in range(plan.workers)]
        path = plan.out / f"{phase}-{depth}-{condition}.npz"
        if path.exists():
            continue
        tuned = known_rates(plan, condition if phase == "study" else "none", depth)
        wait = longest.get((depth, phase), 0.0)
        if (not tuned and (phase, condition) != ("tuning", "none")) or time.monotonic() + wait > deadline:
            print(f"{path.stem}: left, for want of {'time' if tuned else 'rates'}", flush=True)
            left += 1
            continue
        began = time.monotonic()
        seeds = range(plan.seeds[plan.depths.index(depth)])
        runs = plan.study(seeds, tuned) if phase == "study" else plan.tuning()
        done = play(plan, condition, depth, runs, path, deadline)
        if done is None:
            print(f"{path.stem}: stopped, the time is up", flush=True)
            left += 1
            continue
        longest[depth, phase] = max(wait, time.monotonic() - began)
        if phase == "tuning":
            choose(plan, condition, depth, done)
        gc.collect()
        if plan.device == "cuda":
            torch.cuda.empty_cache()
    if SLOW in plan.conditions and not plan.workers and plan.device == "cpu":
        left += run_slow(plan, 0, 1, deadline)
    for process in workers:
        process.wait()
    return left


def run_slow(plan: Plan, first: int, every: int, deadline: float) -> int:
    """Play the seeds first, first + every, ... of weight-gradient on the CPU; return how many stacks are left."""
    left = 0
    for depth, seed in product(plan.depths, range(first, plan.slow_seeds, every)):
        path = plan.out / f"study-{depth}-{SLOW}-{seed}.npz"
        rates = known_rates(plan, "none", depth)
        if not path.exists():
            done = rates and play(plan, SLOW, depth, plan.study([seed], rates), path, deadline)
            left += not done
    return left


def _worker(plan: Plan, number: int, deadline: float) -> subprocess.Popen[bytes]:
    """A process that plays its share of weight-gradient's seeds, and ends by itself at the deadline."""
    command = [
        sys.executable, "-m", "results.cartpole.edl.dissect", "--out", str(plan.out), "--conditions", SLOW,
        "--depths", *map(str, plan.depths), "--steps", str(plan.steps), "--width", str(plan.width),
        "--slow-seeds", str(plan.slow_seeds), "--share", str(number), str(plan.workers),
        "--minutes", str((deadline - time.monotonic()) / 60),
    ]  # fmt: skip
    return subprocess.Popen(command)


def agreement(condition: str, width: int, precision: str, updates: int = 32) -> float:
    """How far apart kernels and PyTorch's operations are on the GPU after some updates: the median over runs.

    Of each run, the distance of the parameters as a share of the way that they have come.
    """
    runs = Runs(np.arange(12), np.full(12, 1e-3), np.full(12, S), (("sgd", 4), ("rmsprop", 4), ("adam", 4)))
    settings = StackSettings(**CONDITIONS[condition], width=width, total_steps=400, swap_every=updates // 2)
    one, other, start = (Stack(settings, runs, "cuda", kernels=k, precision=precision) for k in (True, False, False))
    for stack in (one, other):
        stack.advance(settings.learning_starts + updates)
    apart, way = (one.theta[0] - other.theta[0]).norm(dim=1), (other.theta[0] - start.theta[0]).norm(dim=1)
    return float((apart / way).median())


def warm(plan: Plan) -> list[str]:
    """Compile and check the kernels of all conditions at once, each in a process of its own; return those that fail.

    The compiled kernels are on the disk then.
    """
    began = time.monotonic()
    code = (
        f"from results.cartpole.edl.dissect import *; print(agreement(sys.argv[1], {plan.width}, {plan.precision!r}))"
    )
    names = [name for name in plan.conditions if name not in (SLOW, "transform-normal")]
    started = {
        name: subprocess.Popen(
            [sys.executable, "-c", code, name],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name in names
    }
    failed = []
    for name, process in started.items():
        out, errors = process.communicate()
        try:
            apart = float(out.split()[-1])
        except (IndexError, ValueError):
            apart = float("inf")
            print(f"{name}: its kernels failed\n{errors[-3000:]}", flush=True)
        if not apart < AGREE:
            failed.append(name)
        print(f"{name}: kernels and PyTorch's operations are {apart:.1e} apart", flush=True)
    if "transform" in failed:
        failed.append("transform-normal")
    print(f"kernels compiled and checked in {time.monotonic() - began:.1f} s; failed: {failed or 'none'}", flush=True)
    return failed


def fitted(plan: Plan, seconds: float) -> Plan:
    """The plan with the seeds that fit into the time: at most 100 of a depth, the shallow ones first, at least 44."""
    waves = dict.fromkeys(plan.depths, 1)  # of WAVE runs, which take about the time of one
    stacks, per_step = len([name for name in plan.conditions if name != SLOW]), {}
    for depth in plan.depths:
        runs = plan.study(range(WAVE // len(OPTIMIZERS)), dict.fromkeys(OPTIMIZERS, 1e-4))
        stack = Stack(plan.settings("transform", depth), runs, plan.device, precision=plan.precision)
        stack.advance(stack.settings.learning_starts + 2 * stack.settings.swap_every)
        began = float(stack.theta.sum() * 0) + time.monotonic()  # waits for the device
        stack.advance(MEASURED)
        per_step[depth] = (float(stack.theta.sum() * 0) + time.monotonic() - began) / MEASURED
        del stack
        gc.collect()
    tuning = -(-sum(map(len, RATES.values())) * plan.tuning_seeds // WAVE)

    def needed() -> float:
        every = {depth: per_step[depth] * plan.steps * (waves[depth] + tuning) for depth in plan.depths}
        return sum(stacks * (SPARE * each + OVERHEAD) for each in every.values())

    for depth in plan.depths:
        while WAVE * waves[depth] < 3 * 100 and needed() < seconds:
            waves[depth] += 1
            if needed() > seconds:
                waves[depth] -= 1
                break
    seeds = tuple(min(100, WAVE * waves[depth] // len(OPTIMIZERS)) for depth in plan.depths)
    shown = {depth: round(1e6 * each) for depth, each in per_step.items()}
    print(f"us/step of {WAVE} runs {shown}; seeds {seeds}, about {needed():.0f} s of {seconds:.0f} s", flush=True)
    return replace(plan, seeds=seeds)


def main() -> None:
    """Read the arguments, play, and pack what there is."""
    parse = argparse.ArgumentParser(prog="dissect", description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parse.add_argument("--out", type=Path, default=Path("runs/dissect"))
    parse.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parse.add_argument("--minutes", type=float, default=float("inf"), help="play no longer than this")
    parse.add_argument("--depths", type=int, nargs="+", default=[3, 8, 16], help="numbers of hidden layers")
    parse.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        default=[100],
        help="seeds of the study, for all depths or each; 0: as --minutes allow, by a measurement of the speed alone",
    )
    parse.add_argument("--tuning-seeds", type=int, default=8)
    parse.add_argument("--steps", type=int, default=20_000)
    parse.add_argument("--width", type=int, default=128)
    parse.add_argument("--conditions", nargs="+", default=list(CONDITIONS), choices=list(CONDITIONS))
    parse.add_argument("--precision", default="tf32x3", choices=("tf32x3", "ieee", "tf32"), help="of products on a GPU")
    parse.add_argument("--slow-seeds", type=int, default=20, help=f"seeds of {SLOW}")
    parse.add_argument("--workers", type=int, default=0, help=f"processes that play {SLOW} on the CPU meanwhile")
    parse.add_argument("--share", type=int, nargs=2, help=argparse.SUPPRESS)  # a worker's number, and their count
    parse.add_argument("--threads", type=int, default=1, help="of PyTorch on the CPU")
    parse.add_argument("--cold", action="store_true", help="compile kernels when they are needed, not all at the start")
    args = parse.parse_args()
    deadline = time.monotonic() + 60 * args.minutes
    seeds = args.seeds * len(args.depths) if len(args.seeds) == 1 else args.seeds
    if len(seeds) != len(args.depths):
        parse.error("--seeds: give one number, or one for each of --depths")
    torch.set_num_threads(args.threads)
    plan = Plan(
        args.out, args.device, tuple(args.depths), tuple(seeds), args.tuning_seeds, args.steps, args.width,
        tuple(args.conditions), args.precision, args.slow_seeds, args.workers,
    )  # fmt: skip
    if args.share:
        number, workers = args.share
        run_slow(plan, number, workers, deadline)
        return
    if args.device == "cuda" and not args.cold:
        plan = replace(plan, without_kernels=tuple(warm(plan)))
    if 0 in plan.seeds:
        plan = fitted(plan, deadline - time.monotonic())
    left = run(plan, deadline)
    from results.cartpole.edl.packed import pack  # noqa: PLC0415 (needs the extra "report")

    packed = args.out / "dissection.parquet"
    print(f"{packed}: {pack(args.out, packed, PLAN)} runs; {left} stacks left", flush=True)


if __name__ == "__main__":
    main()
