"""What the runner needs of the place where cells run: this machine's processes, or a Dask cluster's workers."""

from __future__ import annotations

from typing import Protocol

from coop.studies.sweep.folder import CellFolder, Ending


class Executor(Protocol):
    """Runs cells, each in a process of its own that holds the cell's lock."""

    def slots(self) -> int:
        """The number of cells that it takes now."""

    def start(self, folder: CellFolder) -> bool:
        """Start a cell; False if another process holds it or has ended it. Raises OSError if it cannot be started."""

    def ending(self, folder: CellFolder) -> Ending | None:
        """How a cell that it has started ended; None while it runs. Not asked again after an ending."""

    def stop(self, seconds: float) -> None:
        """Ask all cells to stop cleanly, and wait; end those that do not stop within `seconds`."""

    def news(self) -> list[str]:
        """Lines that describe what has happened to the place itself. Raises RunError if it is gone."""
