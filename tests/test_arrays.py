"""Arithmetic for both libraries: what it converts, what it leaves as it is, and by which indices it reads."""

from typing import Any

import numpy as np
import pytest
import torch

from coop.learner.edl.arrays import (
    assign,
    at_least_float32,
    chosen,
    convert_like,
    in_dtype,
    placed,
    widened,
)

LIBRARIES = pytest.mark.parametrize("make", [np.array, torch.tensor], ids=["numpy", "torch"])


@LIBRARIES
def test_values_of_either_library_become_those_of_another_array(make: Any) -> None:
    like = make([1.0]) if make is np.array else torch.ones(1, dtype=torch.float64)
    half = torch.tensor([0.5, -2.0], dtype=torch.bfloat16)
    for values in (half, half.float(), half.double(), half.float().numpy(), half.double().numpy()):
        found = convert_like(values, like)
        assert (type(found), found.dtype) == (type(like), like.dtype)
        assert found.tolist() == [0.5, -2.0]
        target = convert_like([0.0, 0.0], like)  # type: ignore[arg-type]
        assign(target, values)
        assert target.tolist() == [0.5, -2.0]
    assert np.shares_memory(np.asarray(convert_like(like, like)), np.asarray(like))


def test_only_tensors_change_their_dtype() -> None:
    array, exact = np.ones(2, np.float16), torch.ones(2, dtype=torch.float64)
    half = exact.bfloat16()
    for same in (array, exact):
        assert at_least_float32(same) is same
        assert in_dtype(same, None) is same
    assert in_dtype(array, torch.bfloat16) is array
    assert in_dtype(exact, torch.bfloat16).dtype == torch.bfloat16
    assert at_least_float32(half).dtype == torch.float32
    assert widened(array).dtype == np.float64
    assert widened(half).dtype == torch.float64


@LIBRARIES
def test_a_column_of_each_row_is_read_and_written(make: Any) -> None:
    values, actions = make([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), make([2, 0])
    read, written = chosen(values, actions), placed(make([7.0, 8.0]), actions, values)
    assert type(read) is type(written) is type(values)
    assert read.tolist() == [3.0, 4.0]
    assert written.tolist() == [[0.0, 0.0, 7.0], [8.0, 0.0, 0.0]]
    assert values.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
