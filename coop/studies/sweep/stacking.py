"""Which cells of a grid are played side by side in one process: those that differ in nothing but their seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from coop.common.settings.config import RunConfig
from coop.lockstep.compiled.conditions import why_not
from coop.studies.sweep.folder import CellFolder
from coop.studies.sweep.grid import GridFile

Stacks = Mapping[str, tuple[CellFolder, ...]]
"""The cells that share a process, by the name of each."""

MOST = 32  # cells of a process, if nothing else is asked for


def stacks_of(
    grid: GridFile, cells: Sequence[CellFolder], jobs: int, most: int | None
) -> tuple[dict[str, tuple[CellFolder, ...]], list[str]]:
    """The cells that each cell shares a process with, itself among them, by its name; and why others are alone.

    Cells that can't share one, or have none to share it with, are left out.

    most: cells of a process; as many as keep `jobs` processes busy if None, and at most MOST.
    """
    groups: dict[RunConfig, list[CellFolder]] = {}
    for cell in cells:
        groups.setdefault(replace(cell.cell.config, seed=0), []).append(cell)
    reasons: dict[str, int] = {}
    fitting: list[list[CellFolder]] = []
    for config, group in groups.items():
        reason = why_not(config) if grid.mode == "lockstep" else "mode: only lockstep"
        if reason:
            reasons[reason] = reasons.get(reason, 0) + len(group)
        else:
            fitting.append(group)
    found: dict[str, tuple[CellFolder, ...]] = {}
    for group in fitting:
        parts = max(1, -(-jobs // len(fitting)))
        size = most or min(MOST, -(-len(group) // parts))
        for start in range(0, len(group), size):
            part = tuple(group[start : start + size])
            found |= dict.fromkeys((cell.cell.name for cell in part), part) if len(part) > 1 else {}
    return found, [f"{count} cells run by themselves: {reason}" for reason, count in reasons.items()]
