"""Steps a second of stacked CartPole runs, beside the rival's.

    python benchmarks/stacked.py --device cuda

The rival, a jitted JAX DQN with K seeds under vmap on an H100: 13,631 steps/s with one seed, 548,809 with 64, 1,119,797
with 1,024. Here, as there: 4-128-128-128-2, batch 32, a table of 5,000, Adam, an update a step. The rival's targets are
single ones, as here with --single.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch

from coop.studies.stacked.settings import Runs, StackSettings
from coop.studies.stacked.stack import Stack
from results.cartpole.edl import dissect

JAX = {1: 13_631, 64: 548_809, 1024: 1_119_797}


def rate(settings: StackSettings, count: int, device: str, seconds: float, **how: object) -> dict[str, object]:
    """Steps/s of all runs together, compilation and capture not counted."""
    stack = Stack(settings, Runs.of(list(range(count)), "adam", 5e-4, 0.1), device, **how)  # type: ignore[arg-type]
    sync = torch.cuda.synchronize if device == "cuda" else (lambda: None)
    stack.advance(settings.learning_starts + 4 * settings.swap_every)
    sync()
    before, began = stack.step, time.perf_counter()
    while time.perf_counter() - began < seconds and stack.step < settings.total_steps:
        stack.advance(min(4 * settings.swap_every if device == "cuda" else 10, settings.total_steps - stack.step))
        sync()
    took = time.perf_counter() - began
    steps = (stack.step - before) / took
    return {"steps/s": round(count * steps), "us/step": round(1e6 / steps, 1), "path": stack.path}


def main() -> None:
    """Print one line of JSON for each measurement."""
    parse = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parse.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parse.add_argument("--runs", type=int, nargs="+", default=[1, 64, 1024])
    parse.add_argument("--seconds", type=float, default=1.0)
    parse.add_argument("--precision", nargs="+", default=["tf32x3"], choices=("tf32x3", "ieee", "tf32"))
    parse.add_argument("--no-check", action="store_true", help="do not compile and check all kernels first")
    parse.add_argument("--single", action="store_true", help="the rival's single targets and loss")
    parse.add_argument("--deep", action="store_true", help="also the conditions of the dissection by depth")
    args = parse.parse_args()
    torch.set_num_threads(1)
    began = time.monotonic()
    if args.device == "cuda":
        print(json.dumps({"device": torch.cuda.get_device_name(), "torch": torch.__version__}), flush=True)
        if not args.no_check:
            names = ("none", "transform", "matched", "noise", "random")
            plan = dissect.Plan(Path(), "cuda", (3,), (1,), 1, 400, 128, names, args.precision[0])
            dissect.warm(plan)

    def show(settings: StackSettings, count: int, **how: object) -> None:
        at = {"method": settings.method, "feedback": settings.feedback, "hidden": settings.hidden, "runs": count}
        try:
            found = rate(settings, count, args.device, args.seconds, **how)
        except Exception as error:
            found = {"failed": f"{type(error).__name__}: {str(error)[:500]}"}
        seconds = round(time.monotonic() - began, 1)
        print(json.dumps({**at, **found, "jax": JAX.get(count), "at s": seconds}), flush=True)

    shared: dict[str, object] = {"total_steps": 40_000}
    if args.single:
        shared |= {"loss": "huber", "double": False}
    for count in args.runs:
        for method, feedback in (("dqn", "none"), ("coop", "transform")):
            settings = StackSettings(method, feedback, **shared)  # type: ignore[arg-type]
            for precision in args.precision:
                show(settings, count, precision=precision)
            if args.device == "cuda":
                show(settings, count, kernels=False)
    if args.deep:
        for depth, condition in ((3, "transform"), (16, "none"), (16, "transform"), (16, "matched"), (16, "noise")):
            settings = StackSettings(**dissect.CONDITIONS[condition], hidden=depth, total_steps=40_000)
            for count in (132, 264) if condition == "transform" else (132,):
                show(settings, count, precision=args.precision[0])


if __name__ == "__main__":
    main()
