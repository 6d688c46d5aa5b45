"""Checks of what a caller of the Python API gives: one line that names the argument."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop.common.errors import UsageError, first_line


def check_whole(name: str, value: object, least: int, most: int | None = None) -> None:
    """Raise UsageError unless an argument is a whole number within bounds; most: None for no upper one."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not (whole and least <= value <= (value if most is None else most)):  # type: ignore[operator]
        upper = "on" if most is None else f"to {most:,}"
        raise UsageError(f"{name} = {value!r}: must be a whole number from {least} {upper}")


def check_seconds(name: str, value: object) -> None:
    """Raise UsageError unless an argument is a number of seconds."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not number or math.isnan(value) or value < 0:  # type: ignore[operator, arg-type]
        raise UsageError(f"{name} = {value!r}: must be a number of seconds from 0 on")


def check_flag(name: str, value: object) -> None:
    """Raise UsageError unless an argument is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise UsageError(f"{name} = {value!r}: must be True or False")


def has_masked(value: object) -> bool:
    """Whether an array has entries that numpy marks as no data; they become numbers as it is taken for a plain one."""
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))


def as_array(name: str, value: object) -> NDArray[Any]:
    """An argument as an array; raises UsageError for what is none, whatever it raises as it is converted."""
    if has_masked(value):
        raise UsageError(f"{name}: has masked entries; must be an array without any")
    try:
        return np.asarray(value)
    except Exception as error:  # numpy's, or of an object's own `__array__`
        raise UsageError(f"{name}: not an array: {first_line(error)}") from error


def texts(name: str, value: object) -> list[str]:
    """The texts in a list, or anything else that gives them one by one; raises UsageError, also for a single text."""
    if isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable):
        raise UsageError(f"{name} = {value!r}: must be a list of names")
    found = list(value)
    if bad := [each for each in found if not isinstance(each, str)]:
        raise UsageError(f"{name}: {bad[0]!r} is no name; must be a list of names")
    return found
