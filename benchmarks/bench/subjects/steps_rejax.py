"""Steps of rejax's DQN, PERIOD environments side by side for an update: steps_rejax.py PRESET PERIOD.

It is configured like our preset. The time that it takes to compile is not counted.
"""

import sys

import jax
from jax_dqn import apart, step_settings
from jax_rejax import make
from turns import attend, rate

STEPS = 1000  # of a call
settings = step_settings(sys.argv[1], int(sys.argv[2]))
algorithm = make(settings, 1_000_000)
run = jax.jit(
    lambda state: jax.lax.fori_loop(0, STEPS // settings.period, lambda _, now: algorithm.train_iteration(now), state),
    donate_argnums=0,
)
present = [apart(algorithm.init_state(jax.random.PRNGKey(0)))]


def steps() -> None:
    present[0] = jax.block_until_ready(run(present[0]))


steps()
attend(lambda seconds: {"steps/s": rate(steps, seconds, STEPS)})
