"""Changes pictures on request: to grayscale, and to another size."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from common.types import Array

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601


def grayscale(picture: Array) -> NDArray[np.float32]:
    """The brightness of a picture: <dtype>[height, width, 3] -> float32 [height, width]."""
    brightness: NDArray[np.float32] = picture @ _LUMA
    return brightness


def make_resizer(size: tuple[int, ...], to: tuple[int, int]) -> Callable[[Array], Array]:
    """A function that turns pictures [*size] or [*size, channels] into float32 ones of the size `to`.

    Each output pixel is the mean of the input area that it covers.
    """
    rows, columns = _area_weights(size[0], to[0]), _area_weights(size[1], to[1]).T

    def resize(picture: Array) -> Array:
        if picture.ndim == 2:
            return rows @ picture @ columns
        return np.moveaxis(rows @ np.moveaxis(picture, 2, 0) @ columns, 0, 2)

    return resize


def _area_weights(size: int, to: int) -> NDArray[np.float32]:
    """float32 [to, size]: row i holds the share of each input pixel in output pixel i; every row sums to 1."""
    edges = np.arange(to + 1) * (size / to)
    pixel = np.arange(size)
    overlap = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    weights: NDArray[np.float32] = (np.maximum(overlap, 0) * (to / size)).astype(np.float32)
    return weights
