"""Eight emulators of Breakout in a bare loop of ours: acting_loop.py both|emulation (no network, random actions)."""

import sys

import numpy as np
from turns import attend, processor_rate
from work import EMULATORS, EPSILON, acting_config

from coop.actors.policy import EpsilonGreedy
from coop.common.envs.make import env_spec, make_vector_env
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.process.limits import use_threads

use_threads(1)
config = acting_config("bench", EMULATORS, EPSILON)
spec, env = env_spec(config.env), make_vector_env(config.env, EMULATORS, seed=0)
networks = tuple(FlatNetwork(build_network(config.network.kind, spec, (), seed)) for seed in (0, 1))
rng = np.random.default_rng(0)
policy = EpsilonGreedy(networks, spec, rng)
seen = [env.reset()]


def step() -> None:
    actions = policy.act(seen[0], EPSILON) if sys.argv[1] == "both" else rng.integers(spec.num_actions, size=EMULATORS)
    seen[0] = env.step(actions).obs


attend(lambda seconds: processor_rate("steps/s", step, seconds, EMULATORS))
