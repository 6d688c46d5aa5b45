"""rejax's DQN with the settings of others; where those take several steps an update, it steps as many environments."""

from __future__ import annotations

import warnings
from typing import Any

from jax_dqn import Network, Settings, make_env, make_network
from rejax import DQN
from rejax.networks import EpsilonGreedyPolicy

warnings.simplefilter("ignore")


def make(settings: Settings, total: int) -> Any:
    """The algorithm. total: steps of the run."""
    env, params = make_env(settings)
    together = max(1, settings.period // settings.updates)
    algorithm = DQN.create(
        env=env,
        env_params=params,
        num_envs=together,
        num_epochs=1,
        ddqn=False,
        buffer_size=settings.capacity // together * together,
        fill_buffer=settings.starts,
        batch_size=settings.batch,
        learning_rate=settings.rate,
        gamma=settings.gamma,
        eps_end=settings.epsilon,
        exploration_fraction=settings.explored / total,
        total_timesteps=total,
        target_update_freq=settings.target * together,
        polyak=0.0,
    )
    return algorithm.replace(agent=make_network(settings, env.num_actions, EpsilonGreedyPolicy(Network)))
