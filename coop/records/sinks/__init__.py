"""Where the records of a run go: one interface, `Sink`, and the sinks by name among which `--log` chooses.

The run directory's own tables (`files`) are always written. Another sink is one file here and its line in `SINKS`; or
a class of an installed package, which its entry point in the group `coop.sinks` names.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

from coop.common.arguments import texts
from coop.common.errors import CoopError, UsageError, first_line, place
from coop.common.imports import check_extra
from coop.common.messaging.messages.evaluate import EvaluationRow
from coop.common.metrics import TAGS
from coop.common.process.console import say
from coop.common.process.lifecycle import is_interrupt
from coop.common.registry import Registry
from coop.common.types import EpisodeRow

# The first tags of an episode and of a row of metrics.
EPISODE, ROW = "charts/episodic_return", "losses/q_values"
FINAL = "final/return_mean_100"  # the tag of what a run has reached at its end
WELL = ("complete", "stopped by")  # how `exit` of a run begins that has ended as it was to end


class RecordedRun(NamedTuple):
    """The run that a sink records: its directory, its id, and the sweep that it belongs to.

    sweep: the sweep's name; empty for a run by itself. cell: the run's method and seed, and its values of the settings
    that the sweep varies, by dotted name; empty for a run by itself.
    """

    path: Path
    run_id: int
    sweep: str
    cell: Mapping[str, Any] = MappingProxyType({})


class Kept(NamedTuple):
    """What a run has recorded that goes on: lines of episodes.csv and metrics.jsonl, and environment steps."""

    episodes: int
    rows: int
    env_step: int


class Sink:
    """Takes what a run records, in the thread of the run, which waits for it. By itself it takes nothing.

    Whatever a sink that `--log` names raises ends the sink, not the run.

    Attributes:
        name: by which `--log` chooses it.
        extra, library: the extra of this package that brings the library, and the library's import name, if it needs
            one; import it in `__init__`.
    """

    name: ClassVar[str] = ""
    extra: ClassVar[str] = ""
    library: ClassVar[str] = ""

    def __init__(self, run: RecordedRun) -> None:
        """Get ready. Whatever it raises refuses the run, before any record has been changed."""

    @property
    def problem(self) -> str:
        """Why lines are being kept for later; empty if none are."""
        return ""

    def begin(self, settings: Mapping[str, Any], kept: Kept | None) -> None:
        """Take the settings by name, before anything else; whatever it raises refuses the run.

        kept: what the run goes on from, None if it begins.
        """

    def episode(self, row: EpisodeRow) -> None:
        """Take a finished episode."""

    def metrics(self, row: Mapping[str, Any]) -> None:
        """Take a row of metrics, as metrics.jsonl has it."""

    def evaluation(self, row: EvaluationRow) -> None:
        """Take an evaluation."""

    def film(self, gif: bytes, env_step: int) -> None:
        """Take an animated GIF of the acting network after `env_step` steps."""

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """Take the fields of summary.json, at the run's end, and `eval_return_mean` of its newest evaluation or None.

        It may be called again if the run is made longer, and not at all if it is killed.
        """

    def close(self) -> None:
        """Write or send what is left."""


class ScalarSink(Sink):
    """A sink of numbers by tag, over the run's environment steps."""

    def scalars(self, values: Mapping[str, float], env_step: int) -> None:
        """Take scalars by tag."""
        raise NotImplementedError

    def episode(self, row: EpisodeRow) -> None:
        """See `Sink`."""
        end = row.record.end
        self.scalars({EPISODE: end.episode_return, "charts/episodic_length": end.length}, row.record.env_step)

    def metrics(self, row: Mapping[str, Any]) -> None:
        """See `Sink`."""
        numbers = {name: value for name, value in row.items() if name != "env_step" and isinstance(value, int | float)}
        scalars = {TAGS.get(name, f"train/{name}"): value for name, value in numbers.items()}
        self.scalars({ROW: row[f"q{row['acting']}_mean"], **scalars}, row["env_step"])

    def evaluation(self, row: EvaluationRow) -> None:
        """See `Sink`."""
        self.scalars({"eval/return_mean": row.return_mean, "eval/return_sd": row.return_sd}, row.env_step)

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """See `Sink`."""
        final = {FINAL: summary["return_mean_100"], "final/eval_return_mean": summary["eval_return_mean"]}
        numbers = {tag: value for tag, value in final.items() if value is not None and math.isfinite(value)}
        if numbers:
            self.scalars(numbers, summary["env_steps"])


SINKS: Registry[Any] = Registry(
    "log",
    "coop.sinks",
    type,
    {
        "tensorboard": "coop.records.sinks.tensorboard:TensorBoardSink",
        "wandb": "coop.records.sinks.wandb:WandbSink",
        "mlflow": "coop.records.sinks.mlflow:MlflowSink",
    },
)
"""The classes of sinks that `--log` names."""
DEFAULT_LOG = "tensorboard"


def chosen_sinks(log: str | Iterable[str]) -> tuple[str, ...]:
    """The names in a list, or in a text with commas; "none" alone for no sink.

    Raises:
        UsageError: it is neither, or there is no sink of a name, or its library is not installed.
    """
    names = [name.strip() for name in (log.split(",") if isinstance(log, str) else texts("log", log))]
    if names == ["none"]:
        return ()
    for name in names:
        sink = SINKS.get(name)
        if not issubclass(sink, Sink):
            raise UsageError(f"log = {name!r}: {sink.__qualname__} is no Sink")
        if sink.library:
            check_extra(f"--log {name}", sink.extra, sink.library)
    return tuple(dict.fromkeys(names))


class ChosenSinks:
    """The sinks that `--log` names; one that fails is left out from then on, and a line says so."""

    def __init__(self, run: RecordedRun, names: Iterable[str]) -> None:
        """Open them; raises UsageError if one refuses."""
        self._run = run
        self._sinks: dict[str, Sink] = {}
        for name in names:
            with self._refusing(name):
                self._sinks[name] = SINKS.get(name)(run)

    def begin(self, settings: Mapping[str, Any], kept: Kept | None) -> None:
        """See `Sink`; raises UsageError if one refuses."""
        for name, sink in self._sinks.items():
            with self._refusing(name):
                sink.begin(settings, kept)

    @property
    def problem(self) -> str:
        """Why one of them keeps lines; empty if none does."""
        found: list[str] = []
        self.tell(lambda sink: found.append(str(sink.problem)))
        return next(filter(None, found), "")

    def tell(self, call: Callable[[Sink], None]) -> None:
        """Call each of them."""
        for name, sink in list(self._sinks.items()):
            try:
                call(sink)
            except CoopError:  # this process may not write any more
                raise
            except BaseException as error:
                say(f"{self._run.path}: --log {name}: {_raised(error)}; the run goes on without it")
                del self._sinks[name]
                try:
                    sink.close()
                except BaseException as another:
                    _raised(another)

    def close(self) -> None:
        """Close all of them."""
        self.tell(lambda sink: sink.close())
        self._sinks.clear()

    @contextmanager
    def _refusing(self, name: str) -> Iterator[None]:
        """Within it, whatever a sink raises closes all of them and is a UsageError."""
        try:
            yield
        except BaseException as error:
            self.close()
            if isinstance(error, CoopError):
                raise
            raise UsageError(f"--log {name}: {_raised(error)}") from error


def _raised(error: BaseException) -> str:
    """What a sink has raised, which may be SystemExit too; a signal's interrupt is raised again."""
    if is_interrupt(error):
        raise error
    return first_line(error) + place(error)
