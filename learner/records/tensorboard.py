"""Writes a run's TensorBoard file, which may end early if the disk is full."""

from __future__ import annotations

import contextlib
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter


class TensorBoardWriter:
    """Writes scalars for TensorBoard in a separate thread; a failure ends the file, not the run."""

    def __init__(self, path: Path) -> None:
        self._writer: SummaryWriter | None = SummaryWriter(str(path))

    def add(self, name: str, value: float, step: int) -> None:
        """Add one value."""
        if self._writer is None:
            return
        try:
            self._writer.add_scalar(name, value, step)
        except OSError as error:
            print(f"TensorBoard's file ends here: {error.strerror or error}", flush=True)
            self.close()

    def close(self) -> None:
        """Write the remaining values."""
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.suppress(OSError):
                writer.close()
