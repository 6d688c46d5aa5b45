"""What a lockstep step can't do without: steps_bare.py PRESET METHOD PERIOD, for a network of one convolution.

The emulator plays and the network answers; every PERIOD steps the matrix products of an update, and nothing else of it.
"""

import sys
from unittest.mock import patch

import numpy as np
from turns import attend, rate
from work import START, step_config

from common.envs.make import make_vector_env
from common.networks import convolution
from common.networks.convolution import product
from common.process.threads import use_threads
from common.types import Array
from experiments.lockstep import Lockstep
from learner.edl import convolution as backward

use_threads(1)
preset, method, period = sys.argv[1], sys.argv[2], int(sys.argv[3])
config = step_config(preset, method, period)
run = Lockstep(config)
for _ in range(START + 100):
    list(run.play())
products: list[tuple[Array, Array, Array | None]] = []


def recorded(a: Array, b: Array, out: Array | None = None) -> Array:
    products.append((a, b, out))
    return product(a, b, out)


with patch.object(convolution, "product", recorded), patch.object(backward, "product", recorded):
    run.agent.update(run.memory.table.sample(config.learner.batch_size))
network, spec = run.agent.networks[0], run.agent.spec
env = make_vector_env(config.env, 1, 0)
seen = [env.reset()]


def steps() -> None:
    for _ in range(period):
        seen[0] = env.step(network.q_values(seen[0], spec).argmax(1).astype(np.int32)).obs
    for a, b, out in products:
        product(a, b, out)


attend(lambda seconds: {"steps/s": rate(steps, seconds, period)})
