"""Makes the policies of a table. Those of users are checked: what they raise or answer names the setting."""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from coop.common.errors import UsageError
from coop.common.own_code import brief, own_code
from coop.common.registry import Registry, loaded
from coop.common.settings.policies import EVICTIONS, SAMPLERS, EvictionPolicy, Policy, SamplingPolicy
from coop.replay.table.policies import Eviction, Floats, Incoming, Rows, Sampling, TableView

LARGEST_WEIGHT = float(np.finfo(np.float32).max)


def make_policies(eviction: EvictionPolicy, sampling: SamplingPolicy, table: TableView) -> tuple[Eviction, Sampling]:
    """Make both policies of a table.

    Raises:
        UsageError: one can't be loaded, or needs replacement and has none.
        RunError: a user's own one raises an exception.
    """
    if not (table.replacement or sampling.without_replacement):
        raise UsageError(f"sampling: {sampling.name!r} draws with replacement only")
    evicts, draws = _made(eviction, EVICTIONS, table), _made(sampling, SAMPLERS, table)
    return (
        evicts if _is_ours(evicts) else OwnEviction(evicts, _setting(eviction, EVICTIONS)),
        draws if _is_ours(draws) else OwnSampling(draws, _setting(sampling, SAMPLERS)),
    )


class OwnEviction(Eviction):
    """A user's own eviction policy, which sees the transitions that come.

    Its methods raise RunError for an exception of the policy's code, and `admit` UsageError for an answer that breaks
    its promise; where `admit` fails, the table is unchanged.
    """

    def __init__(self, policy: Eviction, setting: str) -> None:
        super().__init__(policy.table)
        self._policy, self._setting = policy, setting

    def admit(self, incoming: Incoming) -> tuple[Rows, slice | Rows]:
        """See `Eviction`: rows intp [n], and a slice or positions intp [n]."""
        with own_code(self._setting):
            answer = self._policy.admit(incoming)
        return self._placed(answer, incoming.count, self.table.size, self.table.capacity)

    def prioritise(self, rows: Rows) -> None:
        """See `Eviction`."""
        with own_code(self._setting):
            self._policy.prioritise(rows)

    def _placed(self, answer: Any, steps: int, size: int, capacity: int) -> tuple[Rows, slice | Rows]:  # noqa: ANN401
        """The answer, once it is seen to be one; steps: transitions of the segment. size: rows in use."""
        given, kept = _pair(answer) or self._refuse(f"{_shown(answer)}, must be (rows, kept)")
        rows = _whole(given)
        if rows is None:
            self._refuse(f"the rows {_shown(given)}, must be whole numbers [n]")
        positions: Rows
        try:
            positions = np.arange(steps)[kept if isinstance(kept, slice) else _array(kept)]
        except IndexError:  # beyond the segment, or no numbers
            positions = np.empty((0, 0), np.intp)
        if positions.ndim != 1 or (np.diff(positions) <= 0).any():
            self._refuse(f"kept {_shown(kept)}, must be a slice, or ascending positions among {steps} transitions")
        count = len(positions)
        fresh = np.sort(rows[rows >= size])
        if len(rows) != count:
            self._refuse(f"{len(rows)} rows for {count} transitions")
        if len(rows) and not 0 <= rows.min() <= rows.max() < capacity:
            self._refuse(f"rows from {rows.min()} to {rows.max()}, must be from 0 to {capacity - 1}")
        if len(np.unique(rows)) < len(rows):
            self._refuse("a row twice")
        if not np.array_equal(fresh, np.arange(size, size + len(fresh))):
            self._refuse(f"rows {fresh.tolist()} with {size} in use: unused rows are filled in order")
        return rows, kept if isinstance(kept, slice) else positions

    def _refuse(self, what: str) -> NoReturn:
        raise UsageError(f"{self._setting}: gives {what}")


class OwnSampling(Sampling):
    """A user's own sampling policy; raises as `OwnEviction`."""

    def __init__(self, policy: Sampling, setting: str) -> None:
        super().__init__(policy.table)
        self._policy, self._setting = policy, setting

    def draw(self, count: int, size: int) -> tuple[Rows, NDArray[np.float32]]:
        """See `Sampling`: rows intp [count], weights float32 [count]."""
        with own_code(self._setting):
            answer = self._policy.draw(count, size)
        given, given_weights = _pair(answer) or self._refuse(f"{_shown(answer)}, must be (rows, weights)")
        rows, weights = _whole(given), _array(given_weights)
        if rows is None:
            self._refuse(f"the rows {_shown(given)}, must be whole numbers [n]")
        if len(rows) != count or weights.shape != (count,):
            self._refuse(f"{len(rows)} rows, weights of shape {weights.shape}, not {count}")
        if not 0 <= rows.min() <= rows.max() < size:
            self._refuse(f"rows {rows.min()} to {rows.max()} of {size} in use")
        if weights.dtype.kind not in "iuf" or not (weights.min() >= 0 and weights.max() <= LARGEST_WEIGHT):
            self._refuse(f"the weights {_shown(weights)}, must be finite numbers from 0")
        return rows, weights.astype(np.float32, copy=False)

    def prioritise(self, rows: Rows, priorities: Floats) -> None:
        """See `Sampling`."""
        with own_code(self._setting):
            self._policy.prioritise(rows, priorities)

    def _refuse(self, what: str) -> NoReturn:
        raise UsageError(f"{self._setting}: draws {what}")


def _made(policy: Policy, registry: Registry[Any], table: TableView) -> Any:  # noqa: ANN401
    make = loaded(policy.make, f"{registry.setting} {policy.name!r}")
    with own_code(_setting(policy, registry)):
        return make(table)


def _setting(policy: Policy, registry: Registry[Any]) -> str:
    return f"{registry.setting} = {policy.name!r}"


def _is_ours(policy: object) -> bool:
    return type(policy).__module__.startswith("coop.")


def _pair(answer: Any) -> tuple[Any, Any] | None:  # noqa: ANN401
    return (answer[0], answer[1]) if isinstance(answer, tuple | list) and len(answer) == 2 else None


def _array(given: Any) -> NDArray[Any]:  # noqa: ANN401
    try:
        return np.asarray(given)
    except Exception:  # whatever a user's own object does
        return np.array(None)


def _whole(given: Any) -> Rows | None:  # noqa: ANN401
    """Whole numbers intp [n]; None if it is something else."""
    rows = _array(given)
    if rows.ndim != 1 or (rows.dtype.kind not in "iu" and rows.size):
        return None
    return rows.astype(np.intp, copy=False)


def _shown(value: object) -> str:
    """A value that is not as it should be, in a few words."""
    if isinstance(value, np.ndarray):
        ends = f" from {value.min():g} to {value.max():g}" if value.size and value.dtype.kind in "biuf" else ""
        return f"{value.dtype}{list(value.shape)}{ends}"
    return brief(value)
