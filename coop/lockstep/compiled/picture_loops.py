"""The loops between the products of a network with one convolution, as `loops` has them for dense networks."""

from __future__ import annotations

import numpy as np

from coop.common.compiling import compiled
from coop.common.types import Array


@compiled
def windows(rows: Array, geometry: Array, out: Array) -> None:
    """What a kernel of step 1 sees at each place of pictures; out's last entry, the ones, stays.

    rows: uint8 [batch, width], of bits. geometry: int64 [5], height, width, channels, the kernel's height and width.
    out: [channels * kernel + 1, places down, places across * batch], written.
    """
    height, width, channels, tall, wide = geometry
    batch, bit, byte = rows.shape[0], 7, 0
    planes = np.empty((channels, height * width * batch), np.float32)
    for pixel in range(height * width):
        for channel in range(channels):
            line = planes[channel, pixel * batch : (pixel + 1) * batch]
            for b in range(batch):
                line[b] = np.float32((rows[b, byte] >> bit) & 1)
            bit -= 1
            if bit < 0:
                bit, byte = 7, byte + 1
    for i in range(out.shape[0] - 1):
        channel, row, column = i // (tall * wide), i // wide % tall, i % wide
        for y in range(out.shape[1]):
            first, line = ((y + row) * width + column) * batch, out[i, y]
            source = planes[channel, first : first + line.shape[0]]
            for b in range(line.shape[0]):
                line[b] = source[b]


@compiled
def muted_column(column: Array, h: Array) -> None:
    """Column [n, batch] <- column * (h > 0)."""
    zero, one = np.float32(0), np.float32(1)
    for i in range(column.shape[0]):
        for b in range(column.shape[1]):
            column[i, b] *= one if h[i, b] > zero else zero


@compiled
def turned(rows: Array, out: Array) -> None:
    """Out [n, batch] <- the transpose of rows [batch, n]."""
    batch, units = rows.shape
    whole = units // 16 * 16
    for start in range(0, whole, 16):  # a line of the cache
        for b in range(batch):
            line = rows[b, start : start + 16]
            for i in range(16):
                out[start + i, b] = line[i]
    for i in range(whole, units):
        for b in range(batch):
            out[i, b] = rows[b, i]


@compiled
def whiten_triples(grams: Array, vectors: Array, square: float, ratio: float, inflation: float, white: Array) -> bool:
    """White float64 [n, batch, 3] <- G^(-1/2) e, as `coop.learner.edl.polar` has it for 3 x 3, operation by operation.

    grams: float32 [n, batch, 3, 3]. vectors: e, float32 [batch, 3]. square, ratio, inflation: its limits. Returns
    whether all are accurate.
    """
    sound = True
    g, a, scaled = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    e, solved, rest = np.empty(3), np.empty(3), np.empty(3)
    for k in range(grams.shape[0]):
        for m in range(grams.shape[1]):
            for i in range(3):
                e[i] = vectors[m, i]
                for j in range(3):
                    g[i, j] = grams[k, m, i, j]
            for i in range(3):
                one, two = (i + 1) % 3, (i + 2) % 3
                for j in range(3):
                    following, last = (j + 1) % 3, (j + 2) % 3
                    a[i, j] = g[one, following] * g[two, last] - g[one, last] * g[two, following]
            determinant = (g[0, 0] * a[0, 0] + g[0, 1] * a[0, 1]) + g[0, 2] * a[0, 2]
            least, most = min(g[0, 0], g[1, 1], g[2, 2]), max(g[0, 0], g[1, 1], g[2, 2])
            safe = least > square and least > ratio * most
            safe &= (g[0, 0] * a[0, 0] + g[1, 1] * a[1, 1]) + g[2, 2] * a[2, 2] < inflation * determinant
            safe &= determinant * inflation**2 > (g[0, 0] * g[1, 1]) * g[2, 2]
            trace, minor = (g[0, 0] + g[1, 1]) + g[2, 2], (a[0, 0] + a[1, 1]) + a[2, 2]
            z = np.sqrt(determinant)
            y = np.sqrt(minor + 2 * z * np.sqrt(3 * trace))
            for _ in range(3):
                x = np.sqrt(trace + 2 * y)
                next_y = np.sqrt(minor + 2 * x * z)
                y = y - (y - next_y) / (1 - z / (x * next_y))
            x = np.sqrt(trace + 2 * y)
            for i in range(3):
                for j in range(3):
                    scaled[i, j] = a[i, j] / determinant
            for i in range(3):
                solved[i] = (scaled[i, 0] * e[0] + scaled[i, 1] * e[1]) + scaled[i, 2] * e[2]
            for i in range(3):
                rest[i] = (a[i, 0] * solved[0] + a[i, 1] * solved[1]) + a[i, 2] * solved[2]
            for i in range(3):
                part = (minor + x * z) * solved[i] - rest[i]
                white[k, m, i] = (y * e[i] + part) / (x * y - z)
            sound &= safe
    return sound
