"""cpprb's replay buffer, which keeps observations and stacks once: table_cpprb.py ITEM SAMPLING."""

import sys

import numpy as np
from cpprb import PrioritizedReplayBuffer, ReplayBuffer
from turns import attend, rate, resident_bytes
from work import BATCH, ITEMS, STEPS, observations

item, sampling = sys.argv[1:]
spec, capacity = ITEMS[item]
seen = np.moveaxis(observations(spec), 1, -1) if spec.stack > 1 else observations(spec)  # it wants the stack last
kind = PrioritizedReplayBuffer if sampling == "prioritized" else ReplayBuffer
before = resident_bytes()
options = {"next_of": "obs", **({"stack_compress": "obs"} if spec.stack > 1 else {})}
columns = {"obs": {"shape": seen.shape[1:], "dtype": seen.dtype}, "act": {"dtype": np.int32}, "rew": {}, "done": {}}
table = kind(capacity, columns, **options)
zeros, ones = np.zeros(STEPS), np.ones(BATCH)


def insert() -> None:
    table.add(obs=seen[:-1], next_obs=seen[1:], act=zeros, rew=zeros, done=zeros)


def draw() -> None:
    batch = table.sample(BATCH)
    if sampling == "prioritized":
        table.update_priorities(batch["indexes"], ones)


while table.get_stored_size() < capacity:
    insert()
grown = (resident_bytes() - before) / capacity
attend(
    lambda seconds: {
        "inserted/s": rate(insert, seconds, STEPS),
        "sampled/s": rate(draw, seconds, BATCH),
        "bytes/transition": grown,
    }
)
