"""Times whole training updates: error-driven learning against backpropagation, hand-written and by autograd.

    python benchmarks/edl.py [--rounds 15]

One thread, float32, batch 32. An update is the learner's: from a batch of transitions it computes targets, forward
pass, feedback and RMSProp step. The methods of a network take turns in one process, each with its own networks; each
round gives every method one turn. Prints the median milliseconds and the ratio to the hand-written gradient ("none"),
with its lowest and highest value over five blocks. For reference, "autograd" is the same update as PyTorch users write
it, and "weight-gradient svd" computes an SVD of each weight gradient.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Mapping

import torch
from made_up import random_batch

from coop.common.networks.network import build_network
from coop.common.process.limits import use_threads
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import validated
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.agent import Agent
from coop.learner.edl.arrays import AnyArray, convert_like
from coop.learner.edl.backprop import Tape
from coop.learner.edl.feedback import FeedbackRule

BATCH, GAMMA, RATE = 32, 0.99, 0.1
BLOCKS = 5

Update = Callable[[], object]


def settings(kind: str, method: str, double: bool) -> RunConfig:
    """The config of a run whose learner uses the feedback `method`."""
    gradient = method not in {"transform", "weight-gradient"}
    edl = {"rate": RATE}
    return validated(
        {
            "method": "g-coop" if gradient else "coop",
            "network": {"kind": kind},
            "learner": {"gamma": GAMMA, "double": double, "learning_rate": 1e-5, "swap_every": 10**9},
            "edl": edl if gradient else {**edl, "feedback": method},
        }
    )


class SvdRule(FeedbackRule):
    """The weight-gradient feedback by an SVD of each weight gradient."""

    def backward(self, tape: Tape, error: AnyArray, s: float, out: Mapping[str, AnyArray]) -> None:
        """See `FeedbackRule`."""
        super().backward(tape, error, 0.0, out)
        for gradient in out.values():
            if gradient.ndim > 1:
                u, values, vh = torch.linalg.svd(torch.as_tensor(gradient).flatten(1), full_matrices=False)
                gradient[:] = convert_like(((u * (values + RATE)) @ vh).view(gradient.shape), gradient)


def make_update(kind: str, spec: EnvSpec, method: str, double: bool) -> Update:
    """Make a function that does one update, always on the same batch."""
    batch, config = random_batch(spec, BATCH), settings(kind, method, double)
    if method == "autograd":
        return autograd(config, spec, batch)
    agent = Agent(config, spec)
    if method.endswith("svd"):
        for network in agent._networks:
            network._rule = SvdRule(network._passes.backprop)
    return lambda: agent.update(batch)


def autograd(config: RunConfig, spec: EnvSpec, batch: Batch) -> Update:
    """The gradient method with PyTorch's modules, autograd and RMSprop."""
    online, target = (build_network(config.network.kind, spec, config.network.hidden, seed) for seed in (0, 1))
    optimizer = torch.optim.RMSprop(online.parameters(), lr=config.learner.learning_rate)

    def update() -> None:
        frames = torch.as_tensor(batch.frames)
        frames = frames.float() / 255 if frames.dtype == torch.uint8 else frames
        obs, next_obs = (
            frames[torch.as_tensor(i)].view(-1, *spec.obs_shape) for i in (batch.obs_index, batch.next_index)
        )
        actions = torch.as_tensor(batch.actions).long().unsqueeze(1)
        with torch.no_grad():
            values = target(next_obs)
            best = online(next_obs).argmax(1, keepdim=True) if config.learner.double else values.argmax(1, keepdim=True)
            discounts = GAMMA * ~torch.as_tensor(batch.terminated)
            targets = torch.as_tensor(batch.rewards) + discounts * values.gather(1, best).squeeze(1)
        errors = online(obs).gather(1, actions).squeeze(1) - targets
        optimizer.zero_grad()
        (0.5 * errors.square() * torch.as_tensor(batch.weights)).mean().backward()
        optimizer.step()

    return update


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
    use_threads(1)
    methods = ["autograd", "none", "transform"]
    cartpole = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
    cases = [("mlp", cartpole, double, 20) for double in (False, True)]
    cases += [("nature", EnvSpec("Atari", (84, 84), "uint8", 4, a), False, 1) for a in (4, 6, 18)]
    for kind, spec, double, repeat in cases:
        title = f"{kind}, {spec.num_actions} actions, {'double' if double else 'single'} targets"
        if options.only in title:
            names = [*methods, "weight-gradient", "weight-gradient svd"] if spec.num_actions in (2, 6) else methods
            compare(title, {name: make_update(kind, spec, name, double) for name in names}, options.rounds, repeat)


if __name__ == "__main__":
    main()
