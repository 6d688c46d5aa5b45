"""Steps of a DQN that JAX compiles as a whole, an update every PERIOD: steps_jax.py PRESET PERIOD.

It is configured like our preset. The time that it takes to compile is not counted.
"""

import sys

import jax
from jax_dqn import compiled, step_settings
from turns import attend, rate

STEPS = 1000  # of a call
settings = step_settings(sys.argv[1], int(sys.argv[2]))
state, run = compiled(settings, 0, STEPS // settings.period)
present = [state]


def steps() -> None:
    present[0] = jax.block_until_ready(run(present[0])[0])


steps()
attend(lambda seconds: {"steps/s": rate(steps, seconds, STEPS)})
