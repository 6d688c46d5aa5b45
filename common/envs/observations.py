"""What an environment's observations become: stored frames of one shape and dtype."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box

from coop.common.envs.checked import of_flags
from coop.common.envs.pictures import grayscale, make_resizer
from coop.common.errors import UsageError
from coop.common.process.output import warn_once
from coop.common.settings.environment import EnvSettings
from coop.common.types import Array

KEPT = ("uint8", "bool")  # dtypes that are stored as they are; all others become float32


class FrameMaker:
    """Makes a frame of each observation: a vector, or a picture height x width (x channels).

    Frames are the observations themselves, unless `env.resize` or `env.grayscale` asks for other pictures.

    shape, dtype: of a frame; dtype is "uint8", "bool" or "float32".
    """

    def __init__(self, settings: EnvSettings, space: Box) -> None:
        """Raise UsageError for pictures with their channels first, or a change of pictures that is not supported."""
        self._name, self._space = f"env.id: {settings.id!r}", space
        self.shape: tuple[int, ...] = space.shape
        self._check()
        self.dtype = str(space.dtype) if str(space.dtype) in KEPT else "float32"
        self._to_gray = settings.grayscale
        if settings.grayscale:
            self._need("env.grayscale = true", len(self.shape) == 3 and self.shape[2] == 3, "three colour channels")
            self.shape = self.shape[:2]
        self._resize = None
        if settings.resize is not None:
            self._need(f"env.resize = {list(settings.resize)}", len(self.shape) > 1, "pictures")
            self._resize = make_resizer(self.shape[:2], settings.resize)
            self.shape = (*settings.resize, *self.shape[2:])
        self._changes = self._to_gray or self._resize is not None

    def __call__(self, observation: Array) -> Array:
        """The frame of an observation, of this shape; its dtype is cast where it is stored."""
        if not self._changes:
            return observation
        picture = grayscale(observation) if self._to_gray else observation
        picture = picture if self._resize is None else self._resize(picture)
        return np.rint(picture) if self.dtype == "uint8" else picture

    def _check(self) -> None:
        """Refuse or warn of spaces that are meant otherwise than they would be taken."""
        space, shape = self._space, list(self._space.shape)
        if space.dtype == np.uint8 and space.high.max() <= 1:
            warn_once(of_flags(self._name))
        if len(shape) == 3 and shape[0] < min(shape[1:]):
            moved = [*shape[1:], shape[0]]
            raise UsageError(
                f"{self._name} has observations {shape}, pictures with their channels first; allowed: height x width x "
                f"channels, {moved}, as gymnasium.wrappers.TransformObservation gives with np.moveaxis(obs, 0, -1)"
            )

    def _need(self, asked: str, holds: bool, what: str) -> None:
        if not holds or self.dtype == "bool":
            found = f"{self._space.dtype}{list(self._space.shape)}"
            raise UsageError(f"{asked}: needs {what} in uint8 or float32; {self._name} has {found}")
