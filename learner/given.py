"""What an update is given: a batch's frames, their rows in observations, and its columns, in one array library."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from coop.common.transitions import Batch
from coop.learner.losses import BatchColumns, columns


class Given(NamedTuple):
    """A batch as arrays of numpy, or as tensors on the networks' device.

    frames: <frame_dtype>[unique, *frame_shape]. index: int32 [2 batch * stack], their rows in the observations, those
    of obs before those of next_obs. s: the exploration rate, and rate: the learning rate; numbers, or tensors of one.
    """

    frames: Any
    index: Any
    columns: BatchColumns[Any]
    s: Any
    rate: Any

    @classmethod
    def of(cls, batch: Batch, gamma: float, s: float, rate: float, device: torch.device | None) -> Given:
        """A batch as it is in numpy, or copied to a device."""
        index, held = indices(batch), columns(batch, gamma)
        if device is None:
            return cls(batch.frames, index, held, s, rate)
        frames: Any = batch.frames
        # Copies, because arrays from the wire are read-only and PyTorch warns about views of those.
        if not isinstance(frames, torch.Tensor):
            frames = torch.tensor(frames, device=device)
        places, *parts = (None if array is None else torch.tensor(array, device=device) for array in (index, *held))
        return cls(frames, places, BatchColumns(*parts), s, rate)


def indices(batch: Batch) -> Any:  # noqa: ANN401
    """The rows of a batch's frames in its observations: int32 [2 batch * stack]."""
    return np.concatenate((batch.obs_index, batch.next_index)).reshape(-1)
