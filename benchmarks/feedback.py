"""What error-driven feedback changes in an update: by layer, of the gradient and of the optimizer's step.

`python benchmarks/feedback.py [--updates N]` trains the network of the CartPole presets by gradient with RMSProp on
transitions of random play, and computes at the same weights what each feedback would have given, with the optimizer's
state that it would have left. Printed, by layer from the first to the last: the ratio of norms and the cosine to those
of the gradient, medians over the first 20 updates and over the last half; and the step's ratio's standard deviation.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Mapping
from itertools import pairwise

import gymnasium
import numpy as np
import pandas as pd
import torch
from torch import Tensor, nn

from coop.learner.edl.feedback import edl_gradients

GAMMA, BATCH, RATE, SWAP = 0.99, 32, 3e-4, 30
S = 0.1
FIRST = 20  # updates
CASES = {"transform, constant s": ("transform", False), "transform, s ~ N(0, 1)": ("transform", True),
         "weight-gradient, constant s": ("weight-gradient", False)}  # fmt: skip
FEEDBACKS = {feedback for feedback, _ in CASES.values()}


def transitions(number: int) -> tuple[Tensor, ...]:
    """Transitions of random play: observations, actions, rewards, next observations, whether an episode ended."""
    env = gymnasium.make("CartPole-v1", max_episode_steps=200)
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    rows = []
    for _ in range(number):
        action = env.action_space.sample()
        after, reward, ended, cut, _ = env.step(action)
        rows.append((obs, action, reward, after, ended))
        obs = env.reset()[0] if ended or cut else after
    return tuple(torch.from_numpy(np.array(column, kind)) for column, kind in zip(
        zip(*rows, strict=True), (np.float32, np.int64, np.float32, np.float32, np.float32), strict=True
    ))  # fmt: skip


class Step:
    """RMSProp's step of every weight matrix, with the state that its own gradients leave."""

    def __init__(self) -> None:
        self._squares: dict[str, Tensor] = {}

    def __call__(self, gradients: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The step for these gradients, by the learning rate."""
        for name, gradient in gradients.items():
            before = self._squares.get(name, torch.zeros_like(gradient))
            self._squares[name] = 0.99 * before + 0.01 * gradient**2
        return {name: gradient / (self._squares[name].sqrt() + 1e-8) for name, gradient in gradients.items()}


def measure(updates: int) -> pd.DataFrame:
    """A row for each case, the first or later updates, and layer: ratio and cosine of the gradient and of the step."""
    torch.manual_seed(0)
    generator = np.random.default_rng(0)
    sizes = [4, 128, 128, 128, 2]
    layers: list[nn.Module] = []
    for one, other in pairwise(sizes):
        layers += [nn.Linear(one, other), nn.ReLU()]
    network = nn.Sequential(*layers[:-1])
    target = copy.deepcopy(network)
    held = transitions(5000)
    steps = {name: Step() for name in (*CASES, "none")}
    rows = []
    for update in range(updates):
        if update % SWAP == 0:
            target = copy.deepcopy(network)
        at = torch.from_numpy(generator.integers(0, 5000, BATCH))
        obs, actions, rewards, after, ended = (column[at] for column in held)
        with torch.no_grad():
            values = network(obs)
            wanted = rewards + GAMMA * (1 - ended) * target(after).amax(1)
            error = torch.zeros_like(values)
            error[torch.arange(BATCH), actions] = (values[torch.arange(BATCH), actions] - wanted) / BATCH
        plain = edl_gradients(network, obs, error, 0.0, "none")
        step = steps["none"](plain)
        at_s = {feedback: edl_gradients(network, obs, error, S, feedback) for feedback in FEEDBACKS}
        for case, (feedback, drawn) in CASES.items():
            share = generator.standard_normal() if drawn else 1.0  # gradients are linear in s
            driven = {name: plain[name] + share * (gradient - plain[name]) for name, gradient in at_s[feedback].items()}
            of_case = steps[case](driven)
            when = "first" if update < FIRST else "later" if update >= updates // 2 else ""
            if when:
                for layer, name in enumerate(name for name in plain if name.endswith("weight")):
                    both = (*_against(driven[name], plain[name]), *_against(of_case[name], step[name]))
                    rows.append((case, when, layer + 1, *both))
        with torch.no_grad():
            for name, parameter in network.named_parameters():
                parameter.sub_(RATE * step[name])
    columns = ["case", "when", "layer", "gradient", "cosine", "step", "step_cosine"]
    groups = pd.DataFrame(rows, columns=columns).groupby(["case", "when", "layer"], sort=False)
    return groups.median().assign(step_sd=groups["step"].std()).reset_index()


def _against(one: Tensor, other: Tensor) -> tuple[float, float]:
    product = float((one * other).sum())
    return float(one.norm() / other.norm()), product / float(one.norm() * other.norm())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--updates", type=int, default=1000)
    print(measure(parser.parse_args().updates).to_string(index=False, float_format="{:.2f}".format))


if __name__ == "__main__":
    main()
