"""The wire format: what goes in comes out, and anything else is refused by the name of its field."""

import contextlib
import struct

import hypothesis.extra.numpy as hnp
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coop.common.errors import BadMessage
from coop.common.messaging import wire

ARRAYS = hnp.arrays(
    st.sampled_from([np.dtype(name) for name in sorted(wire.DTYPES)]),
    hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5),
)

DEEP = "nested more deeply than any interpreter permits: PyTorch's compiler raises its limit to 2,000"


@given(st.dictionaries(st.text("abc", min_size=1, max_size=4), ARRAYS, max_size=4), st.integers(-(2**63), 2**64 - 1))
def test_what_goes_in_comes_out(arrays: dict[str, np.ndarray], number: int) -> None:
    message = wire.decode(bytes(wire.encode("kind", "run", {"n": number, "t": [1.5, "é"]}, arrays)))
    assert (message.kind, message.run, message.fields) == ("kind", "run", {"n": number, "t": [1.5, "é"]})
    assert list(message.arrays) == list(arrays)
    for name, array in arrays.items():
        assert message.arrays[name].dtype == array.dtype
        assert message.arrays[name].shape == array.shape
        assert message.arrays[name].tobytes() == array.tobytes()


@given(st.lists(st.lists(ARRAYS, max_size=3), max_size=5))
def test_memory_used_again_leaves_nothing_behind(messages: list[list[np.ndarray]]) -> None:
    memory = bytearray()
    for arrays in messages:
        named = {str(number): array for number, array in enumerate(arrays)}
        assert wire.encode("k", "r", {}, named, into=memory) is memory
        assert memory == wire.encode("k", "r", {}, named)


def test_arrays_are_aligned_and_viewed_in_place() -> None:
    payload = bytes(wire.encode("k", "r", {}, {"a": np.zeros(3, np.uint8), "b": np.arange(5, dtype=np.int64)}))
    b = wire.decode(payload).arrays["b"]
    start = b.__array_interface__["data"][0] - np.frombuffer(payload, np.uint8).__array_interface__["data"][0]
    assert start % wire.ALIGNMENT == 0
    assert 0 < start < len(payload)


def test_messages_of_equal_shapes_share_a_table_and_nothing_else() -> None:
    one, other = (bytes(wire.encode("k", "r", {"n": n}, {"a": np.full(3, n), "b": np.zeros(0)})) for n in (1, 2))
    first, second = wire.decode(one), wire.decode(other)
    assert first.table is second.table
    assert (first.arrays["a"].tolist(), second.arrays["a"].tolist()) == ([1, 1, 1], [2, 2, 2])
    with pytest.raises(BadMessage, match=r"arrays.a: int64\[3\] at 0 reaches beyond the payload's"):
        wire.decode(other[: len(other) - wire.ALIGNMENT])


def test_large_arrays_stand_between_small_ones() -> None:
    large, small = np.arange(wire.SMALL + 1, dtype=np.int32), np.ones(5, np.uint8)
    arrays = {"a": small, "b": large[::2], "c": np.zeros(0), "d": small, "e": large}
    payload = wire.encode("k", "r", {}, arrays)
    message = wire.decode(bytes(payload))
    for name, array in arrays.items():
        np.testing.assert_array_equal(message.arrays[name], array)
    assert wire.encode("k", "r", {}, arrays, into=bytearray(b"\xff" * len(payload))) == payload


def test_arrays_need_not_be_contiguous() -> None:
    array = np.arange(24, dtype=np.int32).reshape(4, 6)
    for part in (array.T, array[::2, 1:3], array[0, 0]):
        sent = wire.decode(bytes(wire.encode("k", "r", {}, {"a": np.asarray(part)}))).arrays["a"]
        np.testing.assert_array_equal(sent, part)


def _with(**changes: object) -> bytes:
    header = {"protocol": wire.PROTOCOL, "kind": "k", "run": "r", "fields": {}, "arrays": [], **changes}
    packed = msgpack.packb({name: value for name, value in header.items() if value is not ...})
    return _packed(packed.replace(msgpack.packb(DEEP), b"\x91" * 50_000 + b"\xc0"))


def _nested(depth: int) -> object:
    value: object = None
    for _ in range(depth):
        value = [value]
    return value


def _packed(header: bytes, magic: int = wire.MAGIC, length: int | None = None) -> bytes:
    prefix = struct.pack("<II", magic, len(header) if length is None else length)
    return prefix + header + bytes(256)


@pytest.mark.parametrize(
    ("payload", "field"),
    [
        (b"", "payload"),
        (b"1234567", "payload"),
        (_packed(b"", magic=1), "magic"),
        (_packed(b"abc", length=10_000), "header length"),
        (_packed(b"\xc1"), "header"),
        (_with(protocol=DEEP), "header"),
        (_with(arrays=DEEP), "header"),
        (_packed(msgpack.packb([1, 2])), "header"),
        (_with(extra=1), "header"),
        (_with(run=...), "header"),
        (_with(protocol=1), "protocol"),
        (_with(protocol=wire.PROTOCOL + 1), "protocol"),
        (_with(protocol=True), "protocol"),
        (_with(protocol=_nested(400)), "protocol"),
        (_with(fields={"x": DEEP}), "header"),
        (_with(arrays=_nested(400)), "arrays"),
        (_with(kind=5), "kind"),
        (_with(run=None), "run"),
        (_with(fields=[]), "fields"),
        (_with(fields={b"x": 1}), "fields"),
        (_with(arrays={}), "arrays"),
        (_with(arrays=[["a", "uint8", [0], 0]] * 65), "arrays"),
        (_with(arrays=[["a", "uint8", [1]]]), "arrays"),
        (_with(arrays=[[1, "uint8", [1], 0]]), "arrays"),
        (_with(arrays=[["a" * 65, "uint8", [1], 0]]), "arrays"),
        (_with(arrays=[["a", "object", [1], 0]]), "arrays.a"),
        (_with(arrays=[["a", 5, [1], 0]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", 1, 0]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [1.0], 0]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [0, 2**30, 2**30, 2**30], 0]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [-1], 0]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [True], 0]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [2**40], 0]]), "arrays.a"),
        (_with(arrays=[["a", "float64", [2**15, 2**15, 2**15], 0]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [1] * 9, 0]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [1], 3]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [1], -64]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [1], None]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [1], 64 * 100]]), "arrays.a"),
        (_with(arrays=[["a", "uint8", [1], 0], ["a", "uint8", [1], 64]]), "arrays.a"),
    ],
)
def test_refused_by_name(payload: bytes, field: str) -> None:
    with pytest.raises(BadMessage) as caught:
        wire.decode(payload)
    assert caught.value.field == field


def test_a_refusal_is_short() -> None:
    payload = _with(kind="k" * 100_000, protocol="p" * 100_000)
    with pytest.raises(BadMessage) as caught:
        wire.decode(payload)
    assert len(str(caught.value)) < 200


@settings(max_examples=2000)
@given(st.data())
def test_no_mutation_raises_anything_else(data: st.DataObject) -> None:
    arrays = {"a": np.arange(9, dtype=np.float32), "b": np.zeros((2, 3), np.uint8)}
    payload = bytearray(wire.encode("insert", "run", {"x": 1, "y": [1, 2]}, arrays))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    for mutated in (bytes(payload), bytes(payload[:cut])):
        with contextlib.suppress(BadMessage):
            wire.decode(mutated)
