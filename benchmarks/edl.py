"""Time whole training updates: error-driven learning against backpropagation, by hand and by autograd.

    python benchmarks/edl.py [--rounds 15]

One thread, float32, batch 32. An update is: targets, forward, feedback, RMSprop step on the flat buffer. The
methods of a network take turns in one process, each on its own copy of it; a round times each once. Printed are the
median milliseconds and the ratio to the hand-written gradient's, with its lowest and highest value over five blocks.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from common.networks import FlatNetwork, build_network
from common.types import EnvSpec
from learner.edl import FeedbackRule

BATCH, GAMMA, RATE = 32, 0.99, 0.1
BLOCKS = 5


class Update:
    """One network, its target and its optimizer on a fixed batch; calling it makes one update."""

    def __init__(self, kind: str, spec: EnvSpec, method: str, double: bool) -> None:
        self.online = FlatNetwork(build_network(kind, spec, (128, 128, 128), seed=0))
        self.target = FlatNetwork(build_network(kind, spec, (128, 128, 128), seed=1))
        self.optimizer = torch.optim.RMSprop([self.online.flat], lr=1e-5)
        generator = torch.Generator().manual_seed(2)
        self.obs, self.next_obs = torch.rand(2, BATCH, *spec.obs_shape, generator=generator)
        self.actions = torch.randint(spec.num_actions, (BATCH, 1), generator=generator)
        self.rewards = torch.rand(BATCH, 1, generator=generator)
        self.double, self.method = double, method
        feedback, polar_dtype = ("transform", torch.bfloat16) if method == "transform bf16" else (method, None)
        if method in ("autograd", "weight-gradient svd"):
            feedback = "none"
        self.rule = FeedbackRule(self.online.module, feedback, polar_dtype=polar_dtype)
        self.target_rule = FeedbackRule(self.target.module)

    def __call__(self) -> None:
        if self.method == "autograd":
            self.autograd()
        else:
            tape = self.rule.forward(self.obs)
            targets = self.targets(lambda x: self.rule.forward(x).output, lambda x: self.target_rule.forward(x).output)
            error = torch.zeros_like(tape.output)
            error.scatter_(1, self.actions, (tape.output.gather(1, self.actions) - targets).div_(BATCH))
            self.rule.backward(tape, error, RATE, self.online.gradients)
            if self.method == "weight-gradient svd":
                for g in (g for g in self.online.gradients.values() if g.dim() > 1):
                    u, s, vh = torch.linalg.svd(g.flatten(1), full_matrices=False)
                    g.copy_(((u * (s + RATE)) @ vh).view(g.shape))
        self.optimizer.step()

    def targets(self, online: Callable[[Tensor], Tensor], target: Callable[[Tensor], Tensor]) -> Tensor:
        """Bellman targets [batch, 1]."""
        with torch.no_grad():
            values = target(self.next_obs)
            best = values.amax(1, keepdim=True)
            if self.double:
                best = values.gather(1, online(self.next_obs).argmax(1, keepdim=True))
            return self.rewards + GAMMA * best

    def autograd(self) -> None:
        """The plain gradient as PyTorch users write it."""
        targets = self.targets(self.online.module, self.target.module)
        values = self.online(self.obs).gather(1, self.actions)
        self.optimizer.zero_grad(set_to_none=False)
        (0.5 * (values - targets).square().mean()).backward()


def compare(title: str, updates: dict[str, Update], rounds: int, repeat: int) -> None:
    """Print one table: the updates take turns, `repeat` calls at a time."""
    for update in updates.values():
        update()
        update()
    times: dict[str, list[list[float]]] = {name: [[] for _ in range(BLOCKS)] for name in updates}
    for block in range(BLOCKS):
        for _ in range(rounds):
            for name, update in updates.items():
                begin = time.perf_counter()
                for _ in range(repeat):
                    update()
                times[name][block].append((time.perf_counter() - begin) / repeat * 1e3)
    print(f"\n{title}")
    print(f"{'method':22}{'ms':>9}{'ratio':>8}   lowest..highest of {BLOCKS} blocks of {rounds} rounds")
    base = [statistics.median(block) for block in times["none"]]
    for name in updates:
        medians = [statistics.median(block) for block in times[name]]
        ratios = [m / b for m, b in zip(medians, base, strict=True)]
        everything = statistics.median([x for block in times[name] for x in block])
        baseline = statistics.median([x for block in times["none"] for x in block])
        print(f"{name:22}{everything:9.3f}{everything / baseline:8.3f}   {min(ratios):.3f}..{max(ratios):.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15, help="rounds in each of the five blocks")
    parser.add_argument("--only", default="", help="print tables whose title holds this text")
    options = parser.parse_args()
    torch.set_num_threads(1)
    methods = ["autograd", "none", "transform", "transform bf16"]
    cartpole = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
    cases = [("mlp", cartpole, double, 20) for double in (False, True)]
    cases += [("nature", EnvSpec("Atari", (84, 84), "uint8", 4, a), False, 1) for a in (4, 6, 18)]
    for kind, spec, double, repeat in cases:
        title = f"{kind}, {spec.num_actions} actions, {'double' if double else 'single'} targets"
        if options.only in title:
            names = [*methods, "weight-gradient", "weight-gradient svd"] if spec.num_actions in (2, 6) else methods
            compare(title, {name: Update(kind, spec, name, double) for name in names}, options.rounds, repeat)


if __name__ == "__main__":
    main()
