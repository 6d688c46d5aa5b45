"""One run of rejax's DQN to a mean return: learn_rejax.py TASK SEED. Prints [steps, solved].

It has no returns over several steps, and takes the end of an episode by its limit for one of the game.
"""

import json
import sys
from collections import deque

import jax
from gymnax.wrappers.purerl import LogWrapper
from jax_dqn import apart, learning_settings
from jax_rejax import make

LOOKED = 1000  # steps between looks at the returns
settings, mean, most = learning_settings(sys.argv[1])
algorithm = make(settings, most, LogWrapper)
iterations = LOOKED // algorithm.num_envs


def iteration(state, _):
    state = algorithm.train_iteration(state)
    logged = state.env_state
    return state, (logged.episode_lengths == 0, logged.returned_episode_returns)


run = jax.jit(lambda state: jax.lax.scan(iteration, state, None, iterations), donate_argnums=0)
state = apart(algorithm.init_state(jax.random.PRNGKey(int(sys.argv[2]))))
returns: deque[float] = deque(maxlen=100)
steps, solved = 0, False
while steps < most and not solved:
    state, (ended, totals) = run(state)
    for total in totals[ended].tolist():
        returns.append(total)
        solved = solved or (len(returns) == 100 and sum(returns) / 100 >= mean)
    steps += iterations * algorithm.num_envs
print(json.dumps([min(steps, most), solved]))
