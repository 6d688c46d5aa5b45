"""Breaks messages: flips, cuts, splices or invents bytes, and changes headers."""

from __future__ import annotations

import random
import struct
from collections.abc import Sequence
from typing import Any

import msgpack

from coop.common.messaging import wire

_PREFIX = struct.Struct("<II")
_NASTY: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 1, 2**31, 2**40, 2**63 - 1, 2**64 - 1, -(2**63), 0.5, 1e308),
    *(float("nan"), float("inf"), "", "x", "../../etc", "x" * 5000, "\0", b"", b"\xff" * 9, [], {}),
    *([0] * 300, [[[[]]]], {"x": {}}, "float64", "object", [2**30] * 4, [-1], [0, 2**28, 2**28]),
)


def mutate(rng: random.Random, payload: bytes, others: Sequence[bytes]) -> bytes:
    """Break `payload` in a random way; the result may still be a valid message."""
    return rng.choice(_WAYS)(rng, payload, others)


def _flip(rng: random.Random, payload: bytes, others: Sequence[bytes]) -> bytes:
    """Change a few bytes, preferably of the header."""
    broken = bytearray(payload)
    end = len(broken) if rng.random() < 0.5 else min(len(broken), 200)
    for _ in range(rng.randint(1, 8)):
        broken[rng.randrange(end)] = rng.randrange(256)
    return bytes(broken)


def _cut(rng: random.Random, payload: bytes, others: Sequence[bytes]) -> bytes:
    return payload[: rng.randrange(len(payload))]


def _splice(rng: random.Random, payload: bytes, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    return payload[: rng.randrange(len(payload))] + other[rng.randrange(len(other)) :]


def _move(rng: random.Random, payload: bytes, others: Sequence[bytes]) -> bytes:
    """Send another key's message."""
    return rng.choice(others)


def _invent(rng: random.Random, payload: bytes, others: Sequence[bytes]) -> bytes:
    return rng.randbytes(rng.choice((0, 7, 8, 64, 4096)))


def _prefix(rng: random.Random, payload: bytes, others: Sequence[bytes]) -> bytes:
    length = rng.choice((0, 1, len(payload), 2**20, 2**31, 2**32 - 1, rng.randrange(300)))
    return _PREFIX.pack(wire.MAGIC, length) + payload[_PREFIX.size :]


def _header(rng: random.Random, payload: bytes, others: Sequence[bytes]) -> bytes:
    """Replace, drop or add one value of the header, at any depth, and keep the arrays' positions."""
    _, length = _PREFIX.unpack_from(payload)
    start = -(-(_PREFIX.size + length) // wire.ALIGNMENT) * wire.ALIGNMENT
    header = msgpack.unpackb(payload[_PREFIX.size : _PREFIX.size + length], raw=False)
    place: Any = header
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = rng.choice(keys)
        if isinstance(place[key], dict | list) and place[key] and rng.random() < 0.8:
            place = place[key]
            continue
        break
    how = rng.random()
    if how < 0.3 and type(place[key]) is int:
        place[key] += rng.choice((-1, 1, 7))
    elif how < 0.8:
        place[key] = rng.choice(_NASTY)
    elif how < 0.9:
        del place[key]
    elif isinstance(place, dict):
        place[rng.choice(("extra", b"extra", ""))] = rng.choice(_NASTY)
    else:
        place.append(rng.choice(_NASTY))
    packed = msgpack.packb(header)
    gap = -(_PREFIX.size + len(packed)) % wire.ALIGNMENT
    return _PREFIX.pack(wire.MAGIC, len(packed)) + packed + bytes(gap) + payload[start:]


_WAYS = (_flip, _flip, _cut, _splice, _move, _invent, _prefix, _header, _header, _header, _header)
