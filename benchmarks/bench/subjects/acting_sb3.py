"""Stable-Baselines3's collection of eight Breakout emulators, nature network, into its buffer: acting_sb3.py."""

import ale_py
import gymnasium
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_atari_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecFrameStack
from turns import attend, processor_rate
from work import EMULATORS, EPSILON

gymnasium.register_envs(ale_py)
torch.set_num_threads(1)
OPTIONS = {"frameskip": 1, "repeat_action_probability": 0.0}
env = VecFrameStack(make_atari_env("ALE/Breakout-v5", EMULATORS, seed=0, env_kwargs=OPTIONS), 4)
model = DQN("CnnPolicy", env, buffer_size=20_000, device="cpu", seed=0)
model.set_logger(Logger(None, []))
_, callback = model._setup_learn(10**9, None)
model.exploration_rate = EPSILON
once = TrainFreq(1, TrainFrequencyUnit.STEP)


def step() -> None:
    model.collect_rollouts(model.env, callback, once, model.replay_buffer, learning_starts=0)


attend(lambda seconds: processor_rate("steps/s", step, seconds, EMULATORS))
