"""Updates of a jitted DQN in JAX, which draws from a filled buffer: update_jax.py KIND BATCH."""

import sys
from functools import partial

import jax
import jax.numpy as jnp
import optax
from jax_dqn import MINATAR, Network, train_once
from turns import attend, rate

FILLED = 1024  # transitions
CALL = 10  # updates of a call
# By network: the shape and the type of observations, the actions, and the layers.
KINDS = {
    "mlp": ((4,), jnp.float32, 2, {"hidden": (128, 128, 128)}),
    "minatar": ((10, 10, 4), jnp.bool_, 3, MINATAR),
    "nips2013": ((84, 84, 4), jnp.uint8, 6, {"convolutions": ((16, 8, 4), (32, 4, 2)), "hidden": (256,)}),
    "nature": ((84, 84, 4), jnp.uint8, 6, {"convolutions": ((32, 8, 4), (64, 4, 2), (64, 3, 1)), "hidden": (512,)}),
}
shape, dtype, actions, layers = KINDS[sys.argv[1]]
batch = int(sys.argv[2])
network = Network(actions, **layers, scale=1 / 255 if dtype == jnp.uint8 else 1.0)
optimizer = optax.adam(1e-4, eps=1e-8)
keys = jax.random.split(jax.random.PRNGKey(0), 6)
if dtype == jnp.float32:
    seen = jax.random.normal(keys[0], (2, FILLED, *shape))
else:
    seen = jax.random.randint(keys[0], (2, FILLED, *shape), 0, 256 if dtype == jnp.uint8 else 2).astype(dtype)
taken = jax.random.randint(keys[1], (FILLED,), 0, actions)
paid, discounts = jax.random.normal(keys[2], (FILLED,)), jnp.full(FILLED, 0.99)
online, target = (network.init(key, seen[0, :1]) for key in keys[3:5])


def update(state: dict, key: jax.Array) -> tuple[dict, None]:
    rows = jax.random.randint(key, (batch,), 0, FILLED)
    drawn = (seen[0][rows], taken[rows], paid[rows], seen[1][rows], discounts[rows])
    return train_once(network, optimizer, state, drawn), None


@partial(jax.jit, donate_argnums=0)
def run(state: dict, key: jax.Array) -> dict:
    return jax.lax.scan(update, state, jax.random.split(key, CALL))[0]


present = [{"online": online, "target": target, "moments": optimizer.init(online)}, keys[5]]


def updates() -> None:
    present[0], present[1] = jax.block_until_ready(run(present[0], present[1])), jax.random.split(present[1])[0]


updates()
attend(lambda seconds: {"updates/s": rate(updates, seconds, CALL)})
