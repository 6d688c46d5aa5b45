"""Where each parameter of a network lies in its flat buffer."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from numpy.typing import NDArray

from coop.common.types import EnvSpec

if TYPE_CHECKING:
    from torch import Tensor

ArrayT = TypeVar("ArrayT", "Tensor", NDArray[Any])
Layout = list[tuple[str, tuple[int, ...]]]  # name and shape of each parameter, in the order of the buffer


def mlp_layout(spec: EnvSpec, hidden: Sequence[int]) -> Layout:
    """The layout of the kind "mlp": linear layers of the widths in `hidden`, then one for the actions."""
    layout: Layout = []
    width = math.prod(spec.input_shape)
    names = [f"fc{number}" for number in range(1, len(hidden) + 1)]
    for name, size in zip([*names, "out"], [*hidden, spec.num_actions], strict=True):
        layout += [(f"{name}.weight", (size, width)), (f"{name}.bias", (size,))]
        width = size
    return layout


def size_of(layout: Layout) -> int:
    """The number of parameters."""
    return sum(math.prod(shape) for _, shape in layout)


def views(flat: ArrayT, layout: Layout) -> dict[str, ArrayT]:
    """Each parameter's part of a flat array or tensor [P], by name and in the parameter's shape."""
    sizes = [math.prod(shape) for _, shape in layout]
    stops = itertools.accumulate(sizes)
    return {
        name: flat[stop - size : stop].reshape(shape)
        for (name, shape), size, stop in zip(layout, sizes, stops, strict=True)
    }


def digest(layout: Layout) -> str:
    """16 hex digits, equal for two layouts if and only if these are equal; compared when a role joins."""
    return hashlib.sha256(repr(layout).encode()).hexdigest()[:16]
