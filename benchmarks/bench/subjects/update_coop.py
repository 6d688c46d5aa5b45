"""Our updates on one batch in memory: update_coop.py KIND METHOD BATCH DTYPE DEVICE."""

import sys

from made_up import random_batch
from turns import attend, rate
from work import KINDS, update_config

from coop.common.process.limits import use_threads
from coop.common.process.memory import keep_freed_memory
from coop.learner.agent import Agent

kind, method, batch_size, dtype, device = sys.argv[1:]
use_threads(1)
keep_freed_memory()
spec = KINDS[kind][1]
agent = Agent(update_config(kind, method, int(batch_size), dtype, device), spec)
batch = random_batch(spec, int(batch_size))
attend(lambda seconds: {"updates/s": rate(lambda: agent.update(batch), seconds, on=device)})
