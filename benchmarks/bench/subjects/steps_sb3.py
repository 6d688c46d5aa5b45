"""Steps of Stable-Baselines3's DQN, an update every PERIOD, configured like our preset: steps_sb3.py PRESET PERIOD."""

import sys

import gymnasium
import torch
from learn_sb3 import Body, Pictures
from stable_baselines3 import DQN
from stable_baselines3.common.logger import Logger
from turns import attend, rate
from work import START, step_config

STEPS = 100  # of a call
preset, period = sys.argv[1], int(sys.argv[2])
config = step_config(preset, "dqn", period)
learner, replay = config.learner, config.replay
torch.set_num_threads(1)
torch.set_flush_denormal(True)  # its optimizer would take three times as long over denormal numbers
env = gymnasium.make(config.env.id)
policy = {"net_arch": list(config.network.hidden)}
if preset.startswith("minatar"):
    env = Pictures(env)
    policy = {"net_arch": [], "normalize_images": False, "features_extractor_class": Body}
model = DQN(
    "MlpPolicy",
    env,
    learning_rate=learner.learning_rate,
    buffer_size=replay.capacity,
    learning_starts=START,
    batch_size=learner.batch_size,
    train_freq=period,
    gradient_steps=1,
    target_update_interval=learner.swap_every,
    exploration_final_eps=config.actor.epsilon_final,
    policy_kwargs=policy | {"optimizer_kwargs": {"eps": 1e-8}},
    seed=0,
    device="cpu",
)
model.set_logger(Logger(None, []))
model.learn(START + STEPS, log_interval=10**9)
attend(
    lambda seconds: {
        "steps/s": rate(lambda: model.learn(STEPS, log_interval=10**9, reset_num_timesteps=False), seconds, STEPS)
    }
)
