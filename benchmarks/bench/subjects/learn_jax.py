"""One run of a DQN that JAX compiles as a whole to a mean return: learn_jax.py TASK SEED. Prints [steps, solved]."""

import json
import sys

from jax_dqn import compiled, learning_settings, play_to

LOOKED = 1000  # steps between looks at the returns
settings, mean, most = learning_settings(sys.argv[1])
trainings = max(1, LOOKED // settings.period)
state, run = compiled(settings, int(sys.argv[2]), trainings)
print(json.dumps(play_to(mean, most, trainings * settings.period, run, state)))
