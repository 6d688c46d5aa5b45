"""The work that the subjects of an update share: networks, observations and batches by name."""

from __future__ import annotations

from typing import Any

import numpy as np
from made_up import segments
from numpy.typing import NDArray

from coop.common.settings.config import RunConfig
from coop.common.settings.tables import load_tables, resolve
from coop.common.types import EnvSpec

ATARI = EnvSpec("Atari", (84, 84), "uint8", 4, 6)
# By network, the preset whose settings are used, and what it sees.
KINDS = {
    "mlp": ("cartpole-paper", EnvSpec("CartPole-v0", (4,), "float32", 1, 2)),
    "minatar": ("minatar-breakout", EnvSpec("MinAtar/Breakout-v1", (10, 10, 4), "bool", 1, 3)),
    "nips2013": ("space-invaders-small", ATARI),
    "nature": ("space-invaders", ATARI),
}

# Items of a table, named by their observations (28 KB: stacks of Atari frames), and how many it holds.
ITEMS = {
    "400B": (EnvSpec("Vectors", (100,), "float32", 1, 4), 100_000),
    "28KB": (EnvSpec("Atari", (84, 84), "uint8", 4, 4), 10_000),
    "400KB": (EnvSpec("Pictures", (320, 320, 4), "uint8", 1, 4), 1000),
}
STEPS = 64  # of a segment
BATCH = 32
EMULATORS = 8
EPSILON = 0.1
START = 500  # steps of a lockstep run before its first update


def observations(spec: EnvSpec) -> NDArray[Any]:
    """The observations of one segment and the one after it: <frame_dtype>[STEPS + 1, *obs_shape]."""
    segment = next(segments(spec, STEPS))
    stacks: NDArray[Any] = segment.frames[np.vstack((segment.obs_index, segment.next_index[-1:]))]
    return stacks.reshape(STEPS + 1, *spec.obs_shape)


def update_config(
    kind: str,
    method: str,
    batch_size: int,
    dtype: str,
    device: str = "cpu",
    **replay: float,
) -> RunConfig:
    """A preset's settings with single targets, whatever the method: Adam, Huber's loss, as all subjects have it.

    replay: settings of its replay table.
    """
    tables = load_tables(KINDS[kind][0], None)
    tables.pop("methods", None)
    tables["network"] |= {"dtype": dtype}
    adam = {"optimizer": "adam", "learning_rate": 1e-4, "eps": 1e-8, "loss": "huber", "double": False}
    tables["learner"] |= adam | {"batch_size": batch_size, "swap_every": 10_000, "device": device}
    tables["replay"] |= replay
    return resolve({**tables, "run": "bench", "total_steps": 10**12}, method)


def acting_config(run: str, envs: int, epsilon: float) -> RunConfig:
    """Breakout as Mnih et al. played it late in a run, with a limiter that admits everything."""
    tables = load_tables("breakout", None)
    tables["replay"] |= {"capacity": 20_000, "learning_starts": 1000, "tolerance": 1e12}
    tables["actor"] |= {"num_envs": envs, "epsilon_start": epsilon, "epsilon_final": epsilon}
    return resolve({**tables, "run": run, "total_steps": 10**12})


def step_config(preset: str, method: str, period: int) -> RunConfig:
    """A preset of lockstep runs with Adam, single targets and an update every `period` steps, as all subjects have."""
    tables = load_tables(preset, None)
    tables.pop("methods", None)
    tables["learner"] |= {"optimizer": "adam", "eps": 1e-8, "double": False}
    tables["replay"] |= {"learning_starts": START, "ratio": 1 / period}
    return resolve({**tables, "run": "bench", "total_steps": 10**9}, method)
