"""The learner's part of the checkpoints: `learner.pt`, written before the replay service's part and `DONE`."""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import torch
from msgspec.structs import replace

from coop.common.errors import CoopError, UsageError
from coop.common.process.files import FileDigest, write_atomic
from coop.common.process.memory import return_freed_memory
from coop.common.process.output import warn
from coop.common.process.untrusted import check_torch_file
from coop.common.settings.tables import first_difference
from coop.common.types import EnvSpec
from coop.records.checkpoints import (
    LEARNER,
    PART,
    Damaged,
    Manifest,
    begin,
    check_part,
    checkpoint_path,
    exchange,
    finish,
    remove,
    remove_old,
)
from coop.records.resumption import Whole, survey


@contextmanager
def saving_checkpoint(
    run_dir: Path,
    run_id: int,
    number: int,
    learner_state: dict[str, Any],
    *,
    records: Mapping[str, FileDigest],
    fallbacks: Sequence[str] = (),
    settings: str = "",
    keep: bool = False,
) -> Iterator[Path]:
    """Save the learner's part, and seal the checkpoint once the body has made the replay service save its part.

    Deletes checkpoints that are too old. records, fallbacks, settings: see `Manifest`.
    keep: a whole one with this number, which holds the same agent, is only sealed anew; otherwise it is replaced once
        the new one is whole.

    Raises:
        OSError: the run directory cannot be written; nothing is left of this checkpoint but a whole one of before.
    """
    place = path = checkpoint_path(run_dir, number)
    if (whole := _whole(path, number, run_id)) is not None:
        if keep:
            yield path
            finish(run_dir, path, replace(whole, records=dict(records), fallbacks=list(fallbacks), settings=settings))
            return
        path = place.with_name(place.name + PART)
        remove(path)
    try:
        begin(path)
        files = {LEARNER: _write(path / LEARNER, learner_state)}
        yield path
        manifest = Manifest(run_id, number, files, dict(records), list(fallbacks), settings=settings)
        finish(run_dir, path, manifest)
        if path != place:
            exchange(path, place)
    except BaseException:
        remove(path)
        raise
    remove_old(run_dir, number)
    return_freed_memory()


def _write(path: Path, state: dict[str, Any]) -> FileDigest:
    content = io.BytesIO()
    torch.save(state, content)
    return write_atomic(path, content.getvalue())


def _whole(path: Path, number: int, run_id: int) -> Manifest | None:
    with suppress(Damaged):
        return check_part(path, number, run_id)
    return None


def newest_checkpoint(run_dir: Path, settings: str = "", *, replay: bool = False) -> Whole | None:
    """The newest whole checkpoint of a run, with the learner's state, for readers; None if there is none.

    A warning names those that were passed over. settings, replay: see `survey`.

    Raises:
        UsageError: there are checkpoints, but none is whole.
    """
    found = survey(run_dir, replay=replay, settings=settings, load=load_learner)
    if found.newest is None and found.problems:
        raise UsageError(f"{run_dir}: has no complete checkpoint: {found.passed_over}")
    if found.fallback:
        warn(f"{run_dir}: takes checkpoint {found.whole[0].number}; passes over {found.fallback}")
    return found.newest


def load_learner(path: Path) -> dict[str, Any]:
    """Read learner.pt from a checkpoint's folder, without executing any code in it.

    Raises:
        OSError: it cannot be read.
        RunError: it is no whole checkpoint, or declares more than it holds.
    """
    check_torch_file(path / LEARNER)
    try:
        state: dict[str, Any] = torch.load(path / LEARNER, weights_only=True)
    except (pickle.UnpicklingError, RuntimeError) as error:  # whose advice is to execute it all the same
        raise pickle.UnpicklingError(f"PyTorch {torch.__version__} can't read it") from error
    if not isinstance(state, dict):
        raise TypeError("not a learner's state")
    return state


def check_spec(checkpoint: Whole, spec: EnvSpec) -> None:
    """Raise UsageError if the environment is another one than the run was trained in; old checkpoints don't say.

    Called within `fitting`, for what is no spec.
    """
    if (saved := checkpoint.state.get("spec")) is None:
        return
    was = replace(msgspec.convert(saved, EnvSpec), env_id=spec.env_id)
    if found := first_difference(msgspec.structs.asdict(spec), msgspec.structs.asdict(was)):
        name, here, there = found
        raise UsageError(
            f"env.id: {spec.env_id!r} has changed since {checkpoint.path} was saved: {name} is {here}, and was {there}"
        )


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Raise UsageError in place of what fails because a checkpoint, though whole, is not one of this run's agent."""
    try:
        yield
    except CoopError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RuntimeError) as error:
        text = str(error).splitlines()[0] if str(error) else ""
        raise UsageError(f"{path}: not a state of this run: {type(error).__name__}: {text}") from error
