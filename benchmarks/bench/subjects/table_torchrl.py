"""TorchRL's replay buffer, 64 transitions at once: table_torchrl.py ITEM SAMPLING."""

import sys

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, PrioritizedSampler, RandomSampler, TensorDictReplayBuffer
from turns import attend, rate, resident_bytes
from work import BATCH, ITEMS, STEPS, observations

item, sampling = sys.argv[1:]
torch.set_num_threads(1)
spec, capacity = ITEMS[item]
seen = torch.from_numpy(observations(spec))
sampler = PrioritizedSampler(capacity, 0.6, 0.4) if sampling == "prioritized" else RandomSampler()
before = resident_bytes()
table = TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), sampler=sampler, batch_size=BATCH)
zeros = torch.zeros(STEPS, 1)
parts = {"reward": zeros, "done": zeros.bool(), "terminated": zeros.bool(), "observation": seen[1:]}
segment = TensorDict(
    {"observation": seen[:-1], "action": zeros.long(), "next": TensorDict(parts, [STEPS])}, batch_size=[STEPS]
)


def draw() -> None:
    batch = table.sample()
    if sampling == "prioritized":
        batch["td_error"] = torch.rand(BATCH)
        table.update_tensordict_priority(batch)


while len(table) < capacity:
    table.extend(segment)
grown = (resident_bytes() - before) / capacity
attend(
    lambda seconds: {
        "inserted/s": rate(lambda: table.extend(segment), seconds, STEPS),
        "sampled/s": rate(draw, seconds, BATCH),
        "bytes/transition": grown,
    }
)
