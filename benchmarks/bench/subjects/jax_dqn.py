"""A DQN compiled as a whole by JAX, environment and replay buffer included, and what the subjects in JAX share.

The settings are asked of the environment that holds our package and Stable-Baselines3.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import gymnax
import jax
import jax.numpy as jnp
import optax
from bench.comparison import python_of
from flax import linen as nn

MOST_STEPS = {"CartPole-v1": 200, "Breakout-MinAtar": 10**9}  # of an episode
Carry = dict[str, Any]


@dataclass(frozen=True)
class Settings:
    """Of a DQN.

    Attributes:
        env: gymnax's name. hidden: none for MinAtar's network. explored: steps until epsilon is the last one.
        period: steps between trainings. updates: of a training. target: updates between two targets.
    """

    env: str
    hidden: tuple[int, ...]
    capacity: int
    starts: int
    batch: int
    rate: float
    gamma: float
    epsilon: float
    explored: int
    period: int
    updates: int
    target: int
    n_step: int = 1


def asked(modules: str, value: str) -> Any:
    """The value of an expression over modules of the other subjects."""
    program = f"import json, {modules}; print(json.dumps({value}))"
    command, here = [str(python_of("bench")), "-c", program], str(Path(__file__).parent)
    env = {**os.environ, "PYTHONPATH": f"{here}:{os.environ['PYTHONPATH']}"}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=env)
    return json.loads(done.stdout.splitlines()[-1])


def step_settings(preset: str, period: int) -> Settings:
    """Those that `steps_coop.py` and `steps_sb3.py` have."""
    tables = asked("work, msgspec", f"msgspec.to_builtins(work.step_config({preset!r}, 'dqn', {period}))")
    starts, learner, replay = asked("work", "work.START"), tables["learner"], tables["replay"]
    picture = preset.startswith("minatar")
    return Settings(
        env="Breakout-MinAtar" if picture else "CartPole-v1",
        hidden=() if picture else tuple(tables["network"]["hidden"]),
        capacity=replay["capacity"],
        starts=starts,
        batch=learner["batch_size"],
        rate=learner["learning_rate"],
        gamma=learner["gamma"],
        epsilon=tables["actor"]["epsilon_final"],
        explored=1000,
        period=period,
        updates=1,
        target=learner["swap_every"],
    )


def learning_settings(task: str) -> tuple[Settings, float, int]:
    """Those of `learn_sb3.py`; the mean return to be reached, and the steps at most."""
    (mean, most), table = asked(
        "learn, learn_sb3", f"[learn.TASKS[{task!r}], learn_sb3.SETTINGS[{task!r}] | {{'policy_kwargs': {{}}}}]"
    )
    picture = task.startswith("minatar")
    period, updates = table["train_freq"], table["gradient_steps"]
    settings = Settings(
        env="Breakout-MinAtar" if picture else "CartPole-v1",
        hidden=() if picture else (256, 256),
        capacity=table["buffer_size"],
        starts=table["learning_starts"],
        batch=table["batch_size"],
        rate=table["learning_rate"],
        gamma=table["gamma"],
        epsilon=table["exploration_final_eps"],
        explored=int(table["exploration_fraction"] * most),
        period=period,
        updates=updates,
        # Between its trainings Stable-Baselines3 copies targets by steps; here the period counts updates.
        target=max(updates, table["target_update_interval"] * updates // period),
        n_step=table.get("n_steps", 1),
    )
    return settings, mean, most


class Network(nn.Module):
    """ReLU layers, or MinAtar's network; the nature network and its forerunner for `update_jax.py`."""

    action_dim: int
    hidden: tuple[int, ...] = ()
    convolutions: tuple[tuple[int, int, int], ...] = ()  # (channels, size, stride)
    scale: float = 1.0

    @nn.compact
    def __call__(self, obs: jax.Array) -> jax.Array:
        values = obs.astype(jnp.float32) * self.scale
        for channels, size, stride in self.convolutions:
            values = nn.relu(nn.Conv(channels, (size, size), (stride, stride), padding="VALID")(values))
        values = values.reshape(len(values), -1)
        for size in self.hidden:
            values = nn.relu(nn.Dense(size)(values))
        return nn.Dense(self.action_dim)(values)

    def take(self, obs: jax.Array, action: jax.Array) -> jax.Array:
        """The values of these actions."""
        return jnp.take_along_axis(self(obs), action[:, None], 1)[:, 0]


MINATAR = {"convolutions": ((16, 3, 1),), "hidden": (128,)}


def make_network(settings: Settings, actions: int, kind: type[Network] = Network) -> Network:
    """The network of these settings."""
    return kind(actions, **({"hidden": settings.hidden} if settings.hidden else MINATAR))


def make_env(settings: Settings) -> tuple[Any, Any]:
    """Gymnax's environment and its parameters."""
    env, params = gymnax.make(settings.env)
    return env, params.replace(max_steps_in_episode=MOST_STEPS[settings.env])


def train_once(network: Network, optimizer: Any, state: Carry, batch: tuple[jax.Array, ...]) -> Carry:
    """One update with Huber's loss. batch: observations, actions, returns, next observations, their discounts."""
    obs, actions, returns, next_obs, discounts = batch
    goal = returns + discounts * network.apply(state["target"], next_obs).max(1)

    def loss(parameters: Any) -> jax.Array:
        return optax.huber_loss(network.apply(parameters, obs, actions, method="take"), goal).mean()

    gradient = jax.grad(loss)(state["online"])
    step, moments = optimizer.update(gradient, state["moments"], state["online"])
    return state | {"online": optax.apply_updates(state["online"], step), "moments": moments}


def play_to(mean: float, most: int, each: int, run: Callable[[Any], tuple[Any, Any]], state: Any) -> tuple[int, bool]:
    """Play until the mean of 100 returns or so many steps are reached; the steps, and whether the mean was.

    run: plays `each` steps; returns the new state, whether an episode ended with each, and the returns until then.
    """
    returns: deque[float] = deque(maxlen=100)
    steps, solved = 0, False
    while steps < most and not solved:
        state, (ended, totals) = run(state)
        for total in totals[ended].tolist():
            returns.append(total)
            solved = solved or (len(returns) == 100 and sum(returns) / 100 >= mean)
        steps += each
    return min(steps, most), solved


def apart(state: Any) -> Any:
    """The same state, no two arrays of which are one, so that a compiled function may write over them."""
    return jax.tree.map(lambda value: jnp.array(value, copy=True), state)


def compiled(settings: Settings, seed: int, trainings: int) -> tuple[Carry, Callable[[Carry], tuple[Carry, Any]]]:
    """A run's beginning, and what carries it on by as many trainings with the steps before them.

    That returns the new state, and for each step whether an episode ended and its return until then.
    """
    env, params = make_env(settings)
    network, optimizer = make_network(settings, env.num_actions), optax.adam(settings.rate, eps=1e-8)
    capacity, n_step = settings.capacity, settings.n_step
    key, begun, one = jax.random.split(jax.random.PRNGKey(seed), 3)
    obs, env_state = env.reset_env(begun, params)
    kept = jnp.float32 if settings.hidden else jnp.bool_
    online = network.init(one, obs[None])
    buffer = {
        "obs": jnp.zeros((capacity, *obs.shape), kept),
        "next_obs": jnp.zeros((capacity, *obs.shape), kept),
        "actions": jnp.zeros(capacity, jnp.int32),
        "rewards": jnp.zeros(capacity),
        "ended": jnp.zeros(capacity, jnp.bool_),
        "terminated": jnp.zeros(capacity, jnp.bool_),
    }
    state = {
        "key": key, "env": env_state, "obs": obs, "return": jnp.float32(0), "steps": 0, "count": 0, "buffer": buffer,
        "online": online, "target": online, "moments": optimizer.init(online),
    }  # fmt: skip

    def act(state: Carry, _: None) -> tuple[Carry, Any]:
        key, explore, choose, move, begin = jax.random.split(state["key"], 5)
        epsilon = jnp.interp(state["steps"], jnp.array([0, settings.explored]), jnp.array([1.0, settings.epsilon]))
        greedy = network.apply(state["online"], state["obs"][None])[0].argmax()
        chosen = jax.random.randint(choose, (), 0, env.num_actions)
        action = jnp.where(jax.random.uniform(explore) < epsilon, chosen, greedy).astype(jnp.int32)
        next_obs, reached, reward, ended, _ = env.step_env(move, state["env"], action, params)
        # At the limit of steps an episode ends, but its last state has a value.
        terminated = env.is_terminal(reached.replace(time=0), params)
        row = {
            "obs": state["obs"].astype(kept), "next_obs": next_obs.astype(kept), "actions": action, "rewards": reward,
            "ended": ended, "terminated": terminated,
        }  # fmt: skip
        at = state["steps"] % capacity
        buffer = {name: column.at[at].set(row[name]) for name, column in state["buffer"].items()}
        first_obs, first = env.reset_env(begin, params)
        env_state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), first, reached)
        total = state["return"] + reward
        state = state | {
            "key": key, "env": env_state, "obs": jnp.where(ended, first_obs, next_obs), "steps": state["steps"] + 1,
            "return": jnp.where(ended, 0.0, total), "buffer": buffer,
        }  # fmt: skip
        return state, (ended, total)

    def draw(state: Carry, key: jax.Array) -> tuple[jax.Array, ...]:
        buffer, size = state["buffer"], jnp.minimum(state["steps"], capacity)
        start = state["steps"] - size + jax.random.randint(key, (settings.batch,), 0, size - n_step + 1)
        total, last, power = jnp.zeros(settings.batch), start % capacity, jnp.zeros(settings.batch)
        goes_on = jnp.ones(settings.batch, jnp.bool_)
        for k in range(n_step):
            at = (start + k) % capacity
            total += jnp.where(goes_on, settings.gamma**k * buffer["rewards"][at], 0.0)
            last, power = jnp.where(goes_on, at, last), jnp.where(goes_on, k + 1, power)
            goes_on &= ~buffer["ended"][at]
        first = start % capacity
        discounts = settings.gamma**power * ~buffer["terminated"][last]
        return buffer["obs"][first], buffer["actions"][first], total, buffer["next_obs"][last], discounts

    def update(_: int, state: Carry) -> Carry:
        key, drawn = jax.random.split(state["key"])
        state = train_once(network, optimizer, state, draw(state, drawn))
        count = state["count"] + 1
        copied = count % settings.target == 0
        target = jax.lax.cond(copied, lambda: state["online"], lambda: state["target"])
        return state | {"key": key, "count": count, "target": target}

    def training(state: Carry, _: None) -> tuple[Carry, Any]:
        state, seen = jax.lax.scan(act, state, None, settings.period)
        due = state["steps"] > settings.starts
        return jax.lax.cond(due, lambda: jax.lax.fori_loop(0, settings.updates, update, state), lambda: state), seen

    @partial(jax.jit, donate_argnums=0)
    def run(state: Carry) -> tuple[Carry, Any]:
        return jax.lax.scan(training, state, None, trainings)

    return apart(state), run
