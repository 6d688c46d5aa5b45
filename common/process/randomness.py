"""The state of a random generator as plain values, for msgpack and weights_only loading."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def generator_state(rng: np.random.Generator) -> dict[str, Any]:
    """The state of a Generator over PCG64, for `set_generator_state`.

    128-bit numbers become text, because msgpack's integers have 64 bits.
    """
    state = rng.bit_generator.state
    return {**state, "state": {name: str(number) for name, number in state["state"].items()}}


def set_generator_state(rng: np.random.Generator, state: Mapping[str, Any]) -> None:
    """Set `rng` to a state from `generator_state`."""
    rng.bit_generator.state = {**state, "state": {name: int(digits) for name, digits in state["state"].items()}}
