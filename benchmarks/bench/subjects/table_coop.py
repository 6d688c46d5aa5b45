"""Our table in one process: table_coop.py ITEM EVICTION SAMPLING. A draw includes the new priorities that follow it."""

import sys

import numpy as np
from made_up import segments
from turns import attend, rate, resident_bytes
from work import BATCH, ITEMS, STEPS

from coop.replay.table import table as module
from coop.replay.table.table import Table

item, eviction, sampling = sys.argv[1:]
spec, capacity = ITEMS[item]
stream, priorities = segments(spec, STEPS), np.random.default_rng(2)
first, before = next(stream), resident_bytes()
table = Table(spec, capacity, eviction=eviction, sampling=sampling, rng=np.random.default_rng(0))
table.insert(first)
while table.inserted < 1.5 * capacity:
    table.insert(next(stream))
grown = (resident_bytes() - before) / capacity
module.WORTH_COMPILING = table._inserts + 1  # the loops that a table comes to later
table.insert(next(stream))


def draw() -> None:
    batch = table.sample(BATCH)
    if sampling == "prioritized":
        table.update_priorities(batch.ids, priorities.random(BATCH))


attend(
    lambda seconds: {
        "inserted/s": rate(lambda: table.insert(next(stream)), seconds, STEPS),
        "sampled/s": rate(draw, seconds, BATCH),
        "bytes/transition": grown,
    }
)
