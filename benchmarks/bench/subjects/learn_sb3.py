"""One run of Stable-Baselines3's DQN to a mean return: learn_sb3.py TASK SEED. Prints [steps, solved]."""

from __future__ import annotations

import json
import sys
from collections import deque

import gymnasium
import minatar.gym
import numpy as np
import torch
from learn import N_STEPS, PERIODS, RATES, STEPS, TASKS
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from work import KINDS

from coop.common.networks.network import build_network

MINATAR = "minatar-breakout"
# The settings of its zoo, which has none for MinAtar: there its updates a step of Atari games, the rest is as in ours.
SETTINGS = {
    "cartpole": {
        "learning_rate": 2.3e-3,
        "batch_size": 64,
        "buffer_size": 100_000,
        "learning_starts": 1000,
        "gamma": 0.99,
        "target_update_interval": 10,
        "train_freq": 256,
        "gradient_steps": 128,
        "exploration_fraction": 0.16,
        "exploration_final_eps": 0.04,
        "policy_kwargs": {"net_arch": [256, 256]},
    },
    MINATAR: {
        "learning_rate": RATES[MINATAR],
        "batch_size": 32,
        "buffer_size": 100_000,
        "learning_starts": 5000,
        "gamma": 0.99,
        "target_update_interval": PERIODS[MINATAR] * STEPS[MINATAR],
        "train_freq": STEPS[MINATAR],
        "gradient_steps": 1,
        "n_steps": N_STEPS[MINATAR],
        "exploration_fraction": 20_000 / 150_000,
        "exploration_final_eps": 0.05,
    },
}
ENVS = {"cartpole": "CartPole-v0", "minatar-breakout": "MinAtar/Breakout-v1"}


minatar.gym.register_envs()


class Pictures(gymnasium.ObservationWrapper):
    """MinAtar's pictures with the channels first, as numbers."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        height, width, channels = env.observation_space.shape
        self.observation_space = gymnasium.spaces.Box(0, 1, (channels, height, width), np.uint8)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return np.moveaxis(observation, -1, 0).astype(np.uint8)


class Body(BaseFeaturesExtractor):
    """MinAtar's network up to its last ReLU."""

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        super().__init__(space, 128)
        self.body = build_network("minatar", KINDS["minatar"][1], (), 0)[:-1]

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        return self.body(pictures)


class Goal(BaseCallback):
    """Ends the run when the mean return of 100 episodes has got there."""

    def __init__(self, mean: float) -> None:
        super().__init__()
        self.mean, self.solved = mean, False
        self._returns: deque[float] = deque(maxlen=100)

    def _on_step(self) -> bool:
        self._returns.extend(info["episode"]["r"] for info in self.locals["infos"] if "episode" in info)
        self.solved = len(self._returns) == 100 and sum(self._returns) / 100 >= self.mean
        return not self.solved


def main(task: str, seed: int) -> None:
    mean, most = TASKS[task]
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    settings = SETTINGS[task]
    env = gymnasium.make(ENVS[task])
    if task.startswith("minatar"):
        env = Pictures(env)
        policy = {"net_arch": [], "normalize_images": False, "features_extractor_class": Body}
        settings = settings | {"policy_kwargs": policy}
    goal = Goal(mean)
    model = DQN("MlpPolicy", env, seed=seed, device="cpu", **settings)
    model.learn(most, callback=goal, log_interval=10**9)
    print(json.dumps([model.num_timesteps, goal.solved]))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
