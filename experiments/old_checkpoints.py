"""Reads epochs of lockstep runs in the format used before all runs shared one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack

from common.process.files import PIECE
from common.process.untrusted import load_array
from replay.table.table import Table

ACTIONS = "played.npy"


def is_old(epoch: Path) -> bool:
    """True for an epoch in the old format."""
    return (epoch / "replay" / ACTIONS).exists()


def load(
    epoch: Path, state: dict[str, Any], table: Table, replay_actions: Callable[[list[int]], None]
) -> dict[str, Any]:
    """Fill a new table, and convert the state to today's learner.pt; the old format has no wall time."""
    arrays = {path.stem: load_array(path, PIECE) for path in (epoch / "replay").glob("*.npy")}
    replay_actions(arrays.pop(Path(ACTIONS).stem).tolist())
    meta = msgpack.unpackb((epoch / "replay" / "state.msgpack").read_bytes(), strict_map_key=False)["table"]
    table.load_state(meta, arrays)
    counters = {"sequence": 0, "size": len(table), "evicted": table.evicted, "planned": 0, "first_episode": 0}
    drawn = {**counters, "inserted": state["step"], "evicted_unsampled": table.evicted_unsampled}
    return {**state, "drawn": drawn, "seconds": 0.0, "player": {"policy": state["policy"]}}
