"""What a lockstep step can't do without: steps_bare.py PRESET METHOD PERIOD, for a network of one convolution.

The emulator plays and the network answers; every PERIOD steps the matrix products, whitening and optimizer's step of an
update, and nothing else of it.
"""

import sys
from collections.abc import Callable
from functools import partial
from unittest.mock import patch

import numpy as np
from turns import attend, rate
from work import START, step_config

from coop.common.envs.make import make_vector_env
from coop.common.networks import convolution
from coop.common.process.limits import use_threads
from coop.learner.edl import convolution as backward
from coop.learner.edl import numpy_backprop
from coop.lockstep.lockstep import Lockstep

use_threads(1)
preset, method, period = sys.argv[1], sys.argv[2], int(sys.argv[3])
config = step_config(preset, method, period)
run = Lockstep(config)
for _ in range(START + 100):
    list(run.play())
calls: list[Callable[[], object]] = []
within: list[object] = []


def recorded(function: Callable[..., object], *args: object) -> object:
    if not within:
        calls.append(partial(function, *args))
    within.append(function)
    found = function(*args)
    within.pop()
    return found


with (
    patch.object(convolution, "product", partial(recorded, convolution.product)),
    patch.object(backward, "product", partial(recorded, backward.product)),
    patch.object(numpy_backprop, "whitened", partial(recorded, numpy_backprop.whitened)),
    patch.object(np, "dot", partial(recorded, np.dot)),
):
    run.agent.update(run.memory.table.sample(config.learner.batch_size))
calls.append(partial(run.agent.optimizers[run.agent.acting].step, config.learner.learning_rate))
network, spec = run.agent.networks[0], run.agent.spec
env = make_vector_env(config.env, 1, 0)
seen = [env.reset()]


def steps() -> None:
    for _ in range(period):
        seen[0] = env.step(network.q_values(seen[0], spec).argmax(1).astype(np.int32)).obs
    for call in calls:
        call()


attend(lambda seconds: {"steps/s": rate(steps, seconds, period)})
