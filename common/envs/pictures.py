"""Converts pictures of any size to the networks' 84x84 grayscale frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.types import Array

SIDE = 84
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601


class PictureResizer:
    """Converts uint8 pictures [height, width], [height, width, 1] or [height, width, 3] to uint8 [84, 84].

    Each output pixel is the mean of the input area that it covers; an 84x84 gray picture passes unchanged.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._rows = _area_weights(shape[0])
        self._columns = _area_weights(shape[1]).T
        self._same_size = tuple(shape[:2]) == (SIDE, SIDE)

    def __call__(self, picture: Array) -> NDArray[np.uint8]:
        """Convert one picture to a frame, uint8 [84, 84]."""
        if picture.ndim == 3:
            picture = picture[..., 0] if picture.shape[2] == 1 else picture @ _LUMA
        if not self._same_size:
            picture = self._rows @ picture @ self._columns
        return picture if picture.dtype == np.uint8 else np.rint(picture).astype(np.uint8)


def _area_weights(size: int) -> NDArray[np.float32]:
    """float32 [84, size]: row i holds the share of each input pixel in output pixel i; every row sums to 1."""
    edges = np.arange(SIDE + 1) * (size / SIDE)
    pixel = np.arange(size)
    overlap = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    weights: NDArray[np.float32] = (np.maximum(overlap, 0) * (SIDE / size)).astype(np.float32)
    return weights
