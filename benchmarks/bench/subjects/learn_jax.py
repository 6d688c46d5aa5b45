"""One run of a DQN that JAX compiles as a whole to a mean return: learn_jax.py TASK SEED. Prints [steps, solved]."""

import json
import sys
from collections import deque

from jax_dqn import compiled, learning_settings

LOOKED = 1000  # steps between looks at the returns
settings, mean, most = learning_settings(sys.argv[1])
trainings = max(1, LOOKED // settings.period)
state, run = compiled(settings, int(sys.argv[2]), trainings)
returns: deque[float] = deque(maxlen=100)
steps, solved = 0, False
while steps < most and not solved:
    state, (ended, totals) = run(state)
    for total in totals[ended].tolist():
        returns.append(total)
        solved = solved or (len(returns) == 100 and sum(returns) / 100 >= mean)
    steps += trainings * settings.period
print(json.dumps([min(steps, most), solved]))
