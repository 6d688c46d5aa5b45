"""Environments of one's own, as a user's module outside the project has them."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete


class Room(gymnasium.Env[Any, Any]):
    """A walk along a corridor of `side` cells to its right end, within 20 steps.

    kind: "colour" shows uint8 pictures [64, 64, 3], "planes" bool ones [10, 10, 4], "depth" float32 ones [12, 9].
    Every frame differs from every other by a pattern that counts the steps since the environment was made.
    """

    def __init__(self, kind: str = "colour", side: int = 6) -> None:
        shape, dtype, most = {
            "colour": ((64, 64, 3), np.uint8, 255),
            "planes": ((10, 10, 4), np.bool_, 1),
            "depth": ((12, 9), np.float32, 1),
        }[kind]
        self.observation_space = Box(0, most, shape, dtype)
        self.action_space = Discrete(2)
        self.side, self.place, self.count, self.length = side, 0, 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.length = int(self.np_random.integers(self.side - 1)), 0
        return self.observe(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place = max(0, self.place + (1 if action else -1))
        self.length += 1
        arrived = self.place == self.side - 1
        return self.observe(), float(arrived), arrived, self.length == 20, {}

    def observe(self) -> Any:
        space = self.observation_space
        shape, values = space.shape, np.zeros(int(np.prod(space.shape)), np.uint8)
        values[:20] = np.unpackbits(np.frombuffer(np.uint32(self.count).tobytes(), np.uint8))[:20]
        values[20 + self.place] = 1
        self.count += 1
        return (values * space.high.flat[0]).astype(space.dtype).reshape(shape)


gymnasium.register("Room-v0", entry_point=Room)
gymnasium.register("Planes-v0", entry_point=Room, kwargs={"kind": "planes"})
