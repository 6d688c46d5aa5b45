"""Checks that a run fits into the memory of its processes and its data into the messages between roles."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from coop.common.bounds import MAX_PAYLOAD
from coop.common.errors import UsageError
from coop.common.process.limits import memory_limit
from coop.common.settings.config import RunConfig
from coop.common.settings.policies import EVICTIONS
from coop.common.transitions import IN_BATCH, IN_SEGMENT, KEPT, row_bytes
from coop.common.types import EnvSpec

SLOT_BYTES = 3 * 4 + 8  # counters of a frame's slot, and its number
HEADER_BYTES = 1 << 20  # of a message, including the alignment of its arrays
NAME_BYTES = 4 + 8 + 4  # slot, number and place of a frame in an answer to a draw
MIRRORED_BYTES = 4 * NAME_BYTES  # of a frame: smaller ones are sent again, which saves their names
MIRROR_SHARE = 0.25  # of the learner's memory, or what is free of its GPU's: the most for its mirror of the frames
SPARE_SLOTS = 4096


def frame_bytes(spec: EnvSpec) -> int:
    """Bytes of one stored frame."""
    return math.prod(spec.frame_shape) * np.dtype(spec.frame_dtype).itemsize


def estimated_bytes(spec: EnvSpec, capacity: int) -> int:
    """Bytes of a full table with one frame per transition, including the frames' counters; uniform sampling."""
    return capacity * (frame_bytes(spec) + SLOT_BYTES + row_bytes(KEPT, spec) + 2 * 4 * spec.stack)


def check_memory(config: RunConfig, spec: EnvSpec) -> None:
    """Raise UsageError for a table that does not fit into the memory that this process may use."""
    needed, limit = _most_bytes(config, spec), memory_limit()
    if needed > limit.size:
        raise UsageError(f"replay.capacity = {config.replay.capacity:,}: needs up to {needed / 2**30:.1f} GiB, {limit}")


def mirrors(config: RunConfig, spec: EnvSpec) -> bool:
    """Whether the learner keeps a mirror of the table's frames, where it has room."""
    mirror = config.learner.mirror
    return mirror == "on" or (mirror == "auto" and frame_bytes(spec) >= MIRRORED_BYTES)


def mirror_slots(config: RunConfig, spec: EnvSpec) -> int:
    """The most frames that the learner's mirror may hold, as if the table were on this machine, too; 0 for no room."""
    memory = memory_limit().size
    room = min(MIRROR_SHARE * memory, (memory - _most_bytes(config, spec)) / 2)
    return max(0, min(2**31 - 1, int(room) // (frame_bytes(spec) + 8)))  # each with its number


def table_slots(config: RunConfig, spec: EnvSpec) -> int:
    """Slots that a run's full table may come to use, and some for frames of batches that are on their way."""
    return int(1.25 * config.most_held * _copies(config, spec)) + SPARE_SLOTS


def _most_bytes(config: RunConfig, spec: EnvSpec) -> int:
    """Bytes of a run's full table."""
    return estimated_bytes(spec, config.most_held) * _copies(config, spec)


def _copies(config: RunConfig, spec: EnvSpec) -> int:
    """Frames per transition: policies that do not evict in order, and data sets, may keep stack + 1."""
    in_order = EVICTIONS.get(config.replay.eviction).in_order and not config.replay.preload
    return 1 if in_order else spec.stack + 1


def check_messages(config: RunConfig, spec: EnvSpec) -> None:
    """Raise UsageError if a batch, a segment or the parameters may not fit into one message.

    A batch may hold stack + 1 different frames per transition. A step adds one frame to its segment, or two if an
    episode ends with it; a segment may also contain n_step - 1 steps that waited for it.
    """
    room = MAX_PAYLOAD - HEADER_BYTES
    batch = room // ((spec.stack + 1) * (frame_bytes(spec) + NAME_BYTES) + row_bytes(IN_BATCH, spec))
    step = 2 * frame_bytes(spec) + row_bytes(IN_SEGMENT, spec)
    segment = (room - spec.stack * frame_bytes(spec)) // step - (config.replay.n_step - 1)
    allowed = {
        "learner.batch_size": (config.learner.batch_size, batch),
        "actor.segment_steps": (config.actor.segment_steps, segment),
    }
    for name, (value, most) in allowed.items():
        if value > most:
            shape = "x".join(map(str, spec.frame_shape))
            raise UsageError(f"{name} = {value}: allowed: at most {most} with {shape} frames of {spec.env_id!r}")
    if config.network.kind == "mlp":
        widths = (math.prod(spec.obs_shape), *config.network.hidden, spec.num_actions)
        parameters = sum((width + 1) * following for width, following in pairwise(widths))
        if 4 * parameters > room:
            raise UsageError(
                f"network.hidden = {list(config.network.hidden)}: {parameters:,} parameters; "
                f"allowed: at most {room // 4:,}, what a message carries"
            )
