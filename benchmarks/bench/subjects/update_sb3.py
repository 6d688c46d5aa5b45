"""`DQN.train` of Stable-Baselines3, which draws from its filled buffer: update_sb3.py KIND BATCH DEVICE."""

import sys

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn
from torch.utils.flop_counter import FlopCounterMode
from turns import attend, rate
from work import KINDS

from coop.common.networks.network import build_network

FILLED = 1024  # transitions
kind, batch_size, device = sys.argv[1], int(sys.argv[2]), sys.argv[3]
torch.set_num_threads(1)
spec = KINDS[kind][1]
rng = np.random.default_rng(0)


class Spaces(gymnasium.Env):
    """An environment of which only the spaces matter."""

    picture = spec.frame_dtype == "uint8"
    observation_space = gymnasium.spaces.Box(
        0 if picture else -10, 255 if picture else 10, spec.input_shape, np.uint8 if picture else np.float32
    )
    action_space = gymnasium.spaces.Discrete(spec.num_actions)


class Body(BaseFeaturesExtractor):
    """The network up to its last ReLU."""

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        body = build_network(kind, spec, (128, 128, 128), 0)[:-1]
        super().__init__(space, next(layer.out_features for layer in reversed(body) if isinstance(layer, nn.Linear)))
        self.body = body

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        return self.body(pictures)


# For an array of pictures, normalised by 255 as its CnnPolicy does.
policy = {"net_arch": [], "features_extractor_class": Body, "optimizer_kwargs": {"eps": 1e-8}}
model = DQN(
    "MlpPolicy", Spaces(), buffer_size=FILLED, batch_size=batch_size, policy_kwargs=policy, device=device, seed=0
)
model.set_logger(Logger(None, []))
space = Spaces.observation_space
for _ in range(FILLED):
    drawn = rng.integers(0, 256, (2, 1, *space.shape)) if Spaces.picture else rng.random((2, 1, *space.shape))
    obs, next_obs = drawn.astype(space.dtype)
    action, reward, done = rng.integers(0, spec.num_actions, 1), rng.random(1), np.zeros(1)
    model.replay_buffer.add(obs, next_obs, action, reward, done, [{}])


def update() -> None:
    model.train(gradient_steps=1, batch_size=batch_size)


with FlopCounterMode(display=False) as counter:
    update()
flops = counter.get_total_flops()


def turn(seconds: float) -> dict[str, float]:
    updates = rate(update, seconds, on=device)
    return {"updates/s": updates, "GFLOP/s": updates * flops / 1e9}


attend(turn)
