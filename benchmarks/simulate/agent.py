"""An agent of a few numbers, in place of networks: what it learns says which batches it has seen, in which order."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import torch
from numpy.typing import NDArray

from coop.common.settings.config import RunConfig
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.agent import Update

SIZE = 3


class Numbers:
    """A network of three numbers: whose it is, how often it was trained, and a digest of its batches."""

    size = SIZE

    def __init__(self, number: int) -> None:
        self.flat = np.array([number, 0, 0], np.float32)

    def snapshot(self) -> NDArray[np.float32]:
        """A copy of the parameters, float32 [3]."""
        return self.flat.copy()

    def load(self, flat: NDArray[np.float32]) -> None:
        """Set the parameters, float32 [3]."""
        self.flat = np.array(flat, np.float32)

    def layout_digest(self) -> str:
        """See `FlatNetwork`."""
        return "numbers"


class FewNumbers:
    """See `coop.learner.protocol.AnyAgent`."""

    lag = 0
    loss: Any = None
    rule: Any = None
    device = torch.device("cpu")

    def __init__(self, config: RunConfig, spec: EnvSpec) -> None:
        self.config = config
        self.spec = spec
        self.networks = (Numbers(1), Numbers(2))
        self.versions = [0, 0]
        self.acting = 0
        self.updates = 0

    def update(self, batch: Batch) -> Update:
        """Add a digest of the batch to the acting network."""
        flat = self.networks[self.acting].flat
        flat[1] += 1
        flat[2] = (31 * int(flat[2]) + int(batch.ids.sum()) + 7 * int(batch.ids[0])) % 65521
        self.updates += 1
        self.versions[self.acting] = self.updates
        swapped = self.updates % self.config.swap_period == 0
        if swapped:
            self.swap()
        return Update(batch.rewards % 7, 0.0, swapped)

    def swap(self) -> None:
        """The other network acts."""
        self.acting = 1 - self.acting

    def epsilon(self, env_step: int) -> float:
        """See `AnyAgent`."""
        return 0.1

    def feedback_scale(self) -> float:
        """See `AnyAgent`."""
        return 0.0

    def finite(self) -> bool:
        """See `AnyAgent`."""
        return True

    def state(self) -> dict[str, Any]:
        """See `AnyAgent`."""
        return {
            "networks": [network.flat.tolist() for network in self.networks],
            "versions": list(self.versions),
            "acting": self.acting,
            "updates": self.updates,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """See `AnyAgent`."""
        for network, flat in zip(self.networks, state["networks"], strict=True):
            network.load(np.array(flat, np.float32))
        self.versions, self.acting, self.updates = list(state["versions"]), state["acting"], state["updates"]


class NoDiagnostics:
    """In place of `Diagnostics`, which measures networks."""

    def add(self, batch: Batch) -> None:
        """See `Diagnostics`."""

    def state(self) -> dict[str, Any]:
        """See `Diagnostics`."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """See `Diagnostics`."""


class Plain:
    """In place of PyTorch, which takes long to write and read a learner's state without tensors."""

    @staticmethod
    def save(state: dict[str, Any], file: BytesIO) -> None:
        """As `torch.save`."""
        file.write(msgpack.packb(state))

    @staticmethod
    def load(path: Path, *, weights_only: bool) -> Any:  # noqa: ANN401
        """As `torch.load`."""
        return msgpack.unpackb(path.read_bytes())
