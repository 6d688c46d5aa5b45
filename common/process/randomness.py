"""The state of a random generator as plain values that msgpack and weights_only loading take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def generator_state(rng: np.random.Generator) -> dict[str, Any]:
    """What `set_generator_state` needs, of a Generator over PCG64.

    Numbers of 128 bits become text, for msgpack's integers end at 64.
    """
    state = rng.bit_generator.state
    return {**state, "state": {name: str(number) for name, number in state["state"].items()}}


def set_generator_state(rng: np.random.Generator, state: Mapping[str, Any]) -> None:
    """Let `rng` go on where `state` was taken."""
    rng.bit_generator.state = {**state, "state": {name: int(digits) for name, digits in state["state"].items()}}
