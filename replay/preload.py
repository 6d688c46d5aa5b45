"""The transitions of a data set as segments, with which a table is filled before a run's first step."""

from __future__ import annotations

from typing import Any

import numpy as np

from coop.common.errors import BadMessage, UsageError
from coop.common.messaging.messages.insert import check_values
from coop.common.places import absolute, shown
from coop.common.settings.config import RunConfig
from coop.common.transitions import IN_SEGMENT, Segment, filled
from coop.common.types import EnvSpec, EpisodeEnd
from coop.records.datasets import Rows, read_rows
from coop.replay.table.streams import PRELOADED
from coop.replay.table.table import Table


def preload(table: Table, config: RunConfig) -> list[str]:
    """Fill a new table with the data set `replay.preload`; return a line to say, none if there is no data set.

    Raises:
        UsageError: the data set is not one of this environment, or can't be read.
    """
    given = config.replay.preload
    if not given:
        return []
    path, source = absolute(given, "replay.preload"), f"replay.preload = {given!r}"
    for sequence, rows in enumerate(read_rows(path, table.spec, source)):
        try:
            table.preload(as_segment(rows, table.spec, sequence, clip=config.env.clip_rewards))
        except BadMessage as error:
            at = f"transitions {table.preloaded:,} to {table.preloaded + len(rows.actions) - 1:,}"
            raise UsageError(f"{source}: {at}: {str(error).removeprefix('arrays.')}") from error
    if not len(table):
        raise UsageError(f"{source}: holds no transition that the table keeps")
    kept = "" if len(table) == table.preloaded else f", of which it keeps {len(table):,}"
    return [f"the table begins with {table.preloaded:,} transitions of {shown(path)}{kept}"]


def as_segment(rows: Rows, spec: EnvSpec, sequence: int, *, clip: bool) -> Segment:
    """A segment of these rows, with each frame once; clip: rewards of single steps to [-1, 1].

    Raises BadMessage for values that no actor may send.
    """
    steps = len(rows.actions)
    stacks = [obs.reshape(steps, spec.stack, *spec.frame_shape) for obs in (rows.obs, rows.next_obs)]
    frames = np.concatenate(stacks, axis=1).reshape(-1, *spec.frame_shape)
    places: dict[bytes, int] = {}
    index = np.array([places.setdefault(frame.tobytes(), len(places)) for frame in frames], np.int32)
    _, first = np.unique(index, return_index=True)
    index = index.reshape(steps, 2 * spec.stack)
    rewards = np.where(rows.span == 1, rows.rewards.clip(-1, 1), rows.rewards) if clip else rows.rewards
    given = {
        "obs_index": index[:, : spec.stack], "next_index": index[:, spec.stack :], "actions": rows.actions,
        "rewards": rewards, "terminated": rows.terminated, "span": rows.span,
        "mask": rows.mask, "next_mask": rows.next_mask,
    }  # fmt: skip
    columns = filled(IN_SEGMENT, steps, given)
    check_values(spec, {"frames": frames[first], **columns})
    ends = tuple(EpisodeEnd(int(step), 0.0, 1, 0.0, 0.0, 0.0, 0) for step in np.flatnonzero(rows.ends))
    fields: dict[str, Any] = {"frames": frames[first], **columns}
    return Segment(incarnation=0, stream=PRELOADED, sequence=sequence, episodes=ends, **fields)
