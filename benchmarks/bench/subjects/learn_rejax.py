"""One run of rejax's DQN to a mean return: learn_rejax.py TASK SEED. Prints [steps, solved].

It has no returns over several steps, and takes the end of an episode by its limit for one of the game.
"""

import json
import sys

import jax
import jax.numpy as jnp
from jax_dqn import apart, learning_settings, play_to
from jax_rejax import make

LOOKED = 1000  # steps between looks at the returns
settings, mean, most = learning_settings(sys.argv[1])
algorithm = make(settings, most)
iterations = LOOKED // algorithm.num_envs


def iteration(carry, _):
    state, totals = carry
    state = algorithm.train_iteration(state)
    buffer = state.replay_buffer
    newest = (buffer.index - algorithm.num_envs + jnp.arange(algorithm.num_envs)) % buffer.size
    totals, ended = totals + buffer.data.reward[newest], buffer.data.done[newest]
    return (state, jnp.where(ended, 0.0, totals)), (ended, totals)


run = jax.jit(lambda carry: jax.lax.scan(iteration, carry, None, iterations), donate_argnums=0)
state = apart(algorithm.init_state(jax.random.PRNGKey(int(sys.argv[2]))))
carry = state, jnp.zeros(algorithm.num_envs)
print(json.dumps(play_to(mean, most, iterations * algorithm.num_envs, run, carry)))
