"""The learner's mirror of the table's frames in the memory of its GPU, where recorded updates read them by their slots.

A batch then brings its columns and the rows of its frames only. What the GPU is given later, new frames too, it does
after the updates that it was given before, so no frame changes under one.
"""

from __future__ import annotations

from itertools import cycle

import numpy as np
import torch
from numpy.typing import NDArray

from coop.common.messaging.messages.sample import NamedBatch
from coop.common.messaging.mirror import FrameMirror
from coop.common.transitions import Batch
from coop.common.types import Array, EnvSpec
from coop.learner.recorded import event, pinned

_WRITES = 8  # writes on their way to the device
_TOGETHER = 32  # frames of one write


class DeviceMirror(FrameMirror):
    """A mirror whose rows never move: a tensor <frame_dtype>[slots, *frame_shape] on a device.

    A batch whose frames are all here has that tensor as its `frames`; any other one has numpy's, as in host memory.
    """

    def __init__(self, spec: EnvSpec, slots: int, device: torch.device) -> None:
        """Raise RuntimeError if the device has no room."""
        self._device = device
        super().__init__(spec, slots)
        self._staging = cycle([_Staging(self._on_device, device.type == "cuda") for _ in range(_WRITES)])

    def _allocate(self, slots: int) -> int:
        dtype = getattr(torch, self._dtype.name)
        self._on_device = torch.zeros(slots, *self._shape, dtype=dtype, device=self._device)
        return slots

    def _write(self, slots: NDArray[np.int32], frames: Array) -> None:
        for first in range(0, len(slots), _TOGETHER):
            part = slice(first, first + _TOGETHER)
            next(self._staging).write(self._on_device, slots[part], frames[part])

    def _read(self, batch: NamedBatch, here: bool) -> Batch:
        columns = dict(batch.columns)
        if here:
            columns |= {name: batch.slots[columns[name]] for name in ("obs_index", "next_index")}
            rows: Array = self._on_device  # type: ignore[assignment]
            return Batch(frames=rows, **columns)
        places = torch.tensor(batch.slots.clip(max=self.slots - 1), device=self._device)
        found = self._on_device.index_select(0, places).cpu().numpy()
        found[batch.carried] = batch.frames
        return Batch(frames=found, **columns)


class _Staging:
    """Memory on the host from which some frames are written."""

    def __init__(self, rows: torch.Tensor, on_gpu: bool) -> None:
        self._frames = pinned(torch.zeros(_TOGETHER, *rows.shape[1:], dtype=rows.dtype), on_gpu)
        self._slots = pinned(torch.zeros(_TOGETHER, dtype=torch.int64), on_gpu)
        self._on_gpu = on_gpu
        self._written: torch.cuda.Event | None = None

    def write(self, rows: torch.Tensor, slots: NDArray[np.int32], frames: Array) -> None:
        """Begin to write frames, at most `_TOGETHER`, to their rows."""
        if self._written is not None:
            self._written.synchronize()
        count = len(slots)
        self._slots.numpy()[:count] = slots
        self._frames.numpy()[:count] = frames
        places, values = (part[:count].to(rows.device, non_blocking=True) for part in (self._slots, self._frames))
        rows.index_copy_(0, places, values)
        self._written = event() if self._on_gpu else None
