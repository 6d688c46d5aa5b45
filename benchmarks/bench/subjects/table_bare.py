"""The least work of any table: numpy copies new frames into a ring and gathers a batch's: table_bare.py ITEM."""

import sys
from itertools import cycle

import numpy as np
from turns import attend, rate
from work import BATCH, ITEMS, STEPS

spec, capacity = ITEMS[sys.argv[1]]
rng = np.random.default_rng(1)
ring = np.ones((capacity, *spec.frame_shape), spec.frame_dtype)
source = np.ones((STEPS, *spec.frame_shape), spec.frame_dtype)
places = cycle(range(0, capacity - STEPS, STEPS))
starts = rng.integers(0, capacity - spec.stack, (1000, BATCH, 1))
picks = cycle((starts + np.arange(spec.stack + 1)).reshape(1000, -1))


def insert() -> None:
    place = next(places)
    ring[place : place + STEPS] = source


attend(
    lambda seconds: {
        "inserted/s": rate(insert, seconds, STEPS),
        "sampled/s": rate(lambda: ring.take(next(picks), axis=0), seconds, BATCH),
    }
)
