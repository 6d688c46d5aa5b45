"""The memory that a replay table will need, and whether this machine has it."""

from __future__ import annotations

import os

import numpy as np

from common.errors import UsageError
from common.settings.config import RunConfig
from common.types import EnvSpec

# actions, rewards, terminated, param_version, ids, reuse; three counters of the frame's slot.
ROW_BYTES = 4 + 4 + 1 + 8 + 8 + 4 + 3 * 4


def estimated_bytes(spec: EnvSpec, capacity: int) -> int:
    """Memory of a full table whose transitions add one frame each, with the frames' counters and uniform sampling."""
    frame = int(np.prod(spec.frame_shape)) * np.dtype(spec.frame_dtype).itemsize
    return capacity * (frame + ROW_BYTES + 2 * 4 * spec.stack)


def check_memory(config: RunConfig, spec: EnvSpec) -> None:
    """Raise UsageError for a table that this machine can't hold.

    Other evictions than fifo may keep stack + 1 frames for a transition.
    """
    capacity = config.replay.capacity
    copies = 1 if config.replay.eviction == "fifo" else spec.stack + 1
    needed = estimated_bytes(spec, min(capacity, config.total_steps)) * copies
    present = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > present:
        raise UsageError(
            f"replay.capacity = {capacity:,}: needs up to {needed / 2**30:.1f} GiB, this machine has "
            f"{present / 2**30:.1f} GiB"
        )
