"""A loop over a gymnasium vector environment of eight emulators of Breakout, nature network: acting_gymnasium.py."""

import ale_py
import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation
from turns import attend, processor_rate
from work import ATARI, EMULATORS, EPSILON

from coop.common.networks.network import build_network

gymnasium.register_envs(ale_py)
torch.set_num_threads(1)


def make() -> gymnasium.Env:
    env = gymnasium.make("ALE/Breakout-v5", frameskip=1, repeat_action_probability=0.0)
    return FrameStackObservation(AtariPreprocessing(env), 4)


env = gymnasium.vector.SyncVectorEnv([make] * EMULATORS)
network = build_network("nature", ATARI, (), 0)
rng = np.random.default_rng(0)
seen = [env.reset(seed=0)[0]]


def step() -> None:
    with torch.no_grad():
        actions = network(torch.from_numpy(seen[0]).float() / 255)[:, : env.single_action_space.n].argmax(1).numpy()
    explores = rng.random(EMULATORS) < EPSILON
    actions[explores] = rng.integers(env.single_action_space.n, size=int(explores.sum()))
    seen[0] = env.step(actions)[0]


attend(lambda seconds: processor_rate("steps/s", step, seconds, EMULATORS))
