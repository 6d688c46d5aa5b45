"""Stable-Baselines3's replay buffer with its memory optimization, eight environments at once: table_sb3.py ITEM."""

import sys

import gymnasium
import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from turns import attend, rate, resident_bytes
from work import BATCH, ITEMS, observations

ENVS = 8
spec, capacity = ITEMS[sys.argv[1]]
seen = observations(spec)
space = gymnasium.spaces.Box(-np.inf if seen.dtype.kind == "f" else 0, 255, spec.obs_shape, seen.dtype)
before = resident_bytes()
table = ReplayBuffer(
    capacity,
    space,
    gymnasium.spaces.Discrete(spec.num_actions),
    "cpu",
    ENVS,
    optimize_memory_usage=True,
    handle_timeout_termination=False,
)
actions, zeros, infos = np.zeros((ENVS, 1), np.int64), np.zeros(ENVS, np.float32), [{}] * ENVS


def insert() -> None:
    table.add(seen[:ENVS], seen[1 : ENVS + 1], actions, zeros, zeros, infos)


while not table.full:
    insert()
grown = (resident_bytes() - before) / capacity
attend(
    lambda seconds: {
        "inserted/s": rate(insert, seconds, ENVS),
        "sampled/s": rate(lambda: table.sample(BATCH), seconds, BATCH),
        "bytes/transition": grown,
    }
)
