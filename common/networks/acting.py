"""Networks as actors use them: parameters come from the learner, Q-values go out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from coop.common.networks.forward import DenseForward, digest, mlp_layout, preprocess, size_of, views
from coop.common.process.limits import use_threads
from coop.common.settings.config import NetworkSettings
from coop.common.types import EnvSpec


class ActingNetwork(Protocol):
    """A Q-network that is not trained here.

    size: number of parameters.
    """

    @property
    def size(self) -> int:
        """Number of parameters."""
        ...

    def load(self, flat: NDArray[np.float32]) -> None:
        """Overwrite all parameters in place from float32 [P]; raises ValueError for another size."""
        ...

    def q_values(self, obs: NDArray[Any], spec: EnvSpec) -> NDArray[Any]:
        """Q-values [batch, actions] of observations <frame_dtype>[batch, *obs_shape]."""
        ...

    def layout_digest(self) -> str:
        """See `coop.common.networks.forward.digest`."""
        ...


def acting_network(settings: NetworkSettings, spec: EnvSpec, device: str = "cpu") -> ActingNetwork:
    """A network of a run's layout on a device.

    On the CPU an MLP in float32 does without PyTorch, whose import takes seconds and 200 MiB.

    Raises UsageError as `build_network` does.
    """
    if settings.kind == "mlp" and settings.dtype == "float32" and device == "cpu":
        return Mlp(spec, settings.hidden)
    import torch  # noqa: PLC0415 (see above)

    from coop.common.networks.network import FlatNetwork, build_network  # noqa: PLC0415

    use_threads(1)
    module = build_network(settings.kind, spec, settings.hidden, seed=0)
    return FlatNetwork(module.to(device, torch.bfloat16 if settings.dtype == "bfloat16" else torch.float32))


class Mlp:
    """A network of the kind "mlp" in numpy alone.

    flat: float32 [P], all parameters.
    """

    def __init__(self, spec: EnvSpec, hidden: Sequence[int]) -> None:
        self._layout = mlp_layout(spec, hidden)
        self.flat = np.zeros(size_of(self._layout), np.float32)
        parameters = views(self.flat, self._layout)
        weights = {name.removesuffix("weight"): part for name, part in parameters.items() if part.ndim == 2}
        self._forward = DenseForward(
            list(weights), list(weights.values()), [parameters[f"{n}bias"][:, None] for n in weights]
        )

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.flat)

    def load(self, flat: NDArray[np.float32]) -> None:
        """Overwrite all parameters in place from float32 [P]; raises ValueError for another size."""
        if flat.shape != self.flat.shape:
            raise ValueError(f"flat parameters: got shape {flat.shape}, the network has {len(self.flat)}")
        self.flat[:] = flat

    def q_values(self, obs: NDArray[Any], spec: EnvSpec) -> NDArray[Any]:
        """Q-values [batch, actions] of observations <frame_dtype>[batch, *obs_shape]."""
        inputs = preprocess(obs, spec)
        return self._forward(inputs.reshape(len(inputs), -1))

    def layout_digest(self) -> str:
        """See `coop.common.networks.forward.digest`."""
        return digest(self._layout)
