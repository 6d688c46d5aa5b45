"""Frames in the replay service's own memory, which a learner on the same machine copies from there."""

from __future__ import annotations

import math

import numpy as np

from coop.common.errors import BadMessage
from coop.common.process.shared_memory import SharedMemoryReader
from coop.common.types import Array, EnvSpec


class SharedFrames:
    """The slots of another process's frame store, each of one frame.

    The other process keeps the frames of a batch unchanged until it is told that the batch has arrived.
    """

    def __init__(self, address: str, spec: EnvSpec) -> None:
        """Raise OSError if this process does not reach the memory."""
        self.address = address
        self._reader = SharedMemoryReader(address)
        self._shape = spec.frame_shape
        self._dtype = np.dtype(spec.frame_dtype)
        self._whole = np.dtype((np.void, math.prod(spec.frame_shape) * self._dtype.itemsize))
        self._rows = np.empty(0, self._whole)

    def read(self, slots: Array) -> Array:
        """Copy the frames in `slots`, int64 [n]: [n, *frame_shape]; raises BadMessage if there is no such slot."""
        if not len(slots):
            return np.empty((0, *self._shape), self._dtype)
        least, most = slots.item(slots.argmin()), slots.item(slots.argmax())
        if most >= len(self._rows):  # the store may have grown
            memory = self._reader.map()
            self._rows = np.frombuffer(memory, self._whole, len(memory) // self._whole.itemsize)
        if not 0 <= least <= most < len(self._rows):
            raise BadMessage("arrays.slots", f"values from {least} to {most}; there are {len(self._rows)} slots")
        frames = self._rows.take(slots, mode="clip")
        return frames.view(self._dtype).reshape(len(slots), *self._shape)
