"""A user's own rule: what its methods raise, or give and must not, names the setting in one line."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from coop.common.errors import UsageError
from coop.common.own_code import own_code
from coop.common.registry import loaded
from coop.common.settings.config import RunConfig
from coop.common.settings.methods import METHODS
from coop.learner.edl.arrays import convert_like
from coop.learner.methods.rule import HOOKS, UpdateRule


def make_rule(config: RunConfig, rng: np.random.Generator) -> UpdateRule:
    """The rule of a run's method; rng: see `UpdateRule`.

    Raises:
        UsageError: it can't be loaded. RunError: a user's own one raises an exception.
    """
    make = loaded(METHODS.get(config.method).rule, f"method {config.method!r}")
    setting = f"method = {config.method!r}"
    with own_code(setting):
        rule: UpdateRule = make(config, rng)
    return rule if type(rule).__module__.startswith("coop.") else cast("UpdateRule", OwnRule(rule, setting))


class OwnRule:
    """Looks like the rule of a user that it holds, an `UpdateRule`.

    Its methods raise RunError for an exception of the rule's own code, and UsageError for what can't be learned from or
    saved.
    """

    def __init__(self, rule: UpdateRule, setting: str) -> None:
        """setting: that names the rule, with its value."""
        self._rule, self._setting = rule, setting

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        found = getattr(self._rule, name)
        return partial(self._call, name, found) if name in _CALLED else found

    def _call(self, name: str, method: Callable[..., Any], *arguments: Any) -> Any:  # noqa: ANN401
        with own_code(self._setting):
            given = method(*arguments)
        if name in _PROBLEMS and (problem := _PROBLEMS[name](given, *arguments)):
            raise UsageError(f"{self._setting}: {name} {problem}")
        return convert_like(given, arguments[0]) if name == "bootstrap" else given


def _values(given: Any, count: int) -> str:  # noqa: ANN401
    if isinstance(given, Tensor):
        fits = not given.is_complex() and given.dtype != torch.bool
    else:
        fits = isinstance(given, np.ndarray) and given.dtype.kind in "iuf"
    if fits and tuple(given.shape) == (count,):
        return ""
    shown = f"{given.dtype}{list(given.shape)}" if isinstance(given, Tensor | np.ndarray) else type(given).__name__
    return f"gives {shown.removeprefix('torch.')}, must be float32[{count}]"


def _cost(given: Any, *_: Any) -> str:  # noqa: ANN401
    if not isinstance(given, Tensor) or given.numel() != 1:
        shown = f"a tensor of shape {list(given.shape)}" if isinstance(given, Tensor) else type(given).__name__
        return f"gives {shown}, must be a tensor of one"
    return "" if given.requires_grad else "gives a tensor that does not depend on q"


def _metrics(given: Any) -> str:  # noqa: ANN401
    if not isinstance(given, Mapping):
        return f"gives {type(given).__name__}, must be a table of numbers"
    for name, value in given.items():
        try:
            float(value)
        except Exception:  # whatever a user's own object does
            return f"gives {name!r} as {type(value).__name__}, must be a number"
        if not isinstance(name, str):
            return f"gives the name {name!r}, must be a text"
    return ""


def _state(given: Any) -> str:  # noqa: ANN401
    """A state that can't be read again would make checkpoints useless."""
    if not isinstance(given, dict):
        return f"gives {type(given).__name__}, must be a dict"
    file = io.BytesIO()
    try:
        torch.save(given, file)
        file.seek(0)
        torch.load(file, weights_only=True)
    except Exception:  # whatever a user's own object does
        return "can't be saved; allowed: what torch.load reads with weights_only, such as numbers, texts and tensors"
    return ""


_PROBLEMS: dict[str, Callable[..., str]] = {
    "bootstrap": lambda given, next_values, preferred: _values(given, len(next_values)),
    "targets": lambda given, step: _values(given, len(step.actions)),
    "loss": _cost,
    "extra_cost": _cost,
    "metrics": _metrics,
    "state": _state,
}
_CALLED = {*HOOKS, *_PROBLEMS, "load_state"}
