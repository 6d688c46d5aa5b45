"""The parts of `gpu.py` that measure others: a jitted DQN in JAX, and Stable-Baselines3."""

from __future__ import annotations

import argparse
import time

from gpu_figures import figure, per_second


def part_jax(options: argparse.Namespace) -> None:
    """Updates/s of a jitted DQN in JAX: flax, optax, a scan over updates, batches drawn on the device."""
    import flax.linen as nn
    import jax
    import jax.numpy as jnp
    import optax

    class Nature(nn.Module):
        @nn.compact
        def __call__(self, x):
            x = x.astype(jnp.float32) / 255
            for features, kernel, stride in ((32, 8, 4), (64, 4, 2), (64, 3, 1)):
                x = nn.relu(nn.Conv(features, (kernel, kernel), (stride, stride), padding="VALID")(x))
            return nn.Dense(6)(nn.relu(nn.Dense(512)(x.reshape(x.shape[0], -1))))

    network, optimizer = Nature(), optax.adam(1e-4, eps=1.5e-4)
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    frames = jax.random.randint(keys[0], (10_000, 84, 84), 0, 256).astype(jnp.uint8)
    blank = jnp.zeros((1, 84, 84, 4))
    online, target = network.init(keys[1], blank), network.init(keys[2], blank)
    for batch in (4,) if options.quick else (32, 512):

        def update(state, key, batch=batch):
            parameters, moments = state
            drawn, acted, paid = jax.random.split(key, 3)
            index = jax.random.randint(drawn, (batch, 1), 0, 9_990) + jnp.arange(4)
            obs, next_obs = (frames[index + i].transpose(0, 2, 3, 1) for i in (0, 1))
            actions, rewards = jax.random.randint(acted, (batch, 1), 0, 6), jax.random.normal(paid, (batch,))
            best = network.apply(parameters, next_obs).argmax(1)[:, None]
            goal = rewards + 0.99 * jnp.take_along_axis(network.apply(target, next_obs), best, 1)[:, 0]

            def loss(parameters):
                values = jnp.take_along_axis(network.apply(parameters, obs), actions, 1)[:, 0]
                return optax.huber_loss(values, goal).mean()

            updates, moments = optimizer.update(jax.grad(loss)(parameters), moments, parameters)
            return (optax.apply_updates(parameters, updates), moments), 0.0

        count = 2 if options.quick else 200
        many = jax.jit(lambda state, key: jax.lax.scan(update, state, jax.random.split(key, count))[0])
        state = jax.block_until_ready(many((online, optimizer.init(online)), keys[0]))
        done, began = 0, time.perf_counter()
        while time.perf_counter() - began < (0.1 if options.quick else 1.5):
            state = jax.block_until_ready(many(state, keys[done % 3]))
            done += 1
        taken = time.perf_counter() - began
        row = {"what": "updates/s", "method": "JAX dqn", "batch": batch, "device": str(jax.devices()[0])}
        figure(**row, way="drawn on the device, a scan", value=round(done * count / taken, 1))


def part_sb3(options: argparse.Namespace) -> None:
    """Updates/s of Stable-Baselines3's DQN, from its own buffer."""
    import gymnasium
    import numpy as np
    from stable_baselines3 import DQN
    from stable_baselines3.common.logger import Logger

    class Spaces(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 255, (4, 84, 84), np.uint8)
        action_space = gymnasium.spaces.Discrete(6)

    for batch in (4,) if options.quick else (32, 512):
        model = DQN("CnnPolicy", Spaces(), buffer_size=1024, batch_size=batch, device=options.device, seed=0)
        model.set_logger(Logger(None, []))
        rng = np.random.default_rng(0)
        for _ in range(1024):
            obs, next_obs = rng.integers(0, 256, (2, 1, 4, 84, 84)).astype(np.uint8)
            model.replay_buffer.add(obs, next_obs, np.array([rng.integers(6)]), np.zeros(1), np.zeros(1), [{}])
        update = lambda: model.train(gradient_steps=1, batch_size=batch)  # noqa: E731
        row = {"what": "updates/s", "method": "Stable-Baselines3", "batch": batch}
        figure(**row, way="batches of the host", value=per_second(update, 0.1 if options.quick else 2, options.device))
