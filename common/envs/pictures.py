"""Changes pictures on request: to grayscale, to another size, and to colours for people."""

from __future__ import annotations

from collections.abc import Callable
from colorsys import hsv_to_rgb

import numpy as np
from numpy.typing import NDArray

from coop.common.types import Array

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601


def grayscale(picture: Array) -> NDArray[np.float32]:
    """The brightness of a picture: <dtype>[height, width, 3] -> float32 [height, width]."""
    brightness: NDArray[np.float32] = picture @ _LUMA
    return brightness


def coloured(frame: Array) -> NDArray[np.uint8]:
    """A picture of any numbers, [height, width] or [height, width, channels], in colour: uint8 [height, width, 3].

    One channel is grey, three are red, green and blue; of other numbers of channels, each has a colour of its own, and
    the last one that is not 0 shows. Floats run from the least to the largest value.
    """
    if frame.dtype.kind == "f":
        low, high = float(frame.min()), float(frame.max())
        frame = ((frame - low) * (255 / max(high - low, 1e-12))).astype(np.uint8)
    elif frame.dtype == np.bool_:
        frame = frame.view(np.uint8) * np.uint8(255)
    elif frame.dtype != np.uint8:
        frame = np.clip(frame, 0, 255).astype(np.uint8)
    if frame.ndim == 2 or frame.shape[2] == 1:
        return np.repeat(frame.reshape(*frame.shape[:2], 1), 3, axis=2)
    if frame.shape[2] == 3:
        return frame
    colours = np.array([hsv_to_rgb(number / frame.shape[2], 0.65, 1.0) for number in range(frame.shape[2])])
    picture = np.zeros((*frame.shape[:2], 3))
    for channel, colour in zip(np.moveaxis(frame, 2, 0), colours, strict=True):
        picture = np.where(channel[..., None] > 0, channel[..., None] * colour, picture)
    return picture.astype(np.uint8)


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
