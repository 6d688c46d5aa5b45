"""Follows one run by the files in its folder, whatever writes them: processes, lockstep, a cell of a sweep."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from coop.common.bounds import MAX_POINTS
from coop.common.errors import RunError
from coop.common.messaging.messages.status import LearnerStatus, Measured, Member, Ratio
from coop.common.metrics import MEASURED, METRICS
from coop.common.numbers import RETURN_WINDOW, finite
from coop.common.process.console import RECENT, progress_line, stamped
from coop.monitor.curves import Point, Thinned
from coop.records.checkpoints import RECORDS
from coop.records.growing import Evaluations, GrowingFile, GrowingTable
from coop.records.locks import holder
from coop.records.reading import parse_row, read_run_config
from coop.records.summaries import read_summary

LOGS = ("logs/learner.log", "run.log")  # of coop-local, and of a sweep's cell
_HOLDER = re.compile(r"(\S+) on (\S+) \(pid (\d+)\)")
_PROGRESS = re.compile(r"(\S+ )?step [\d,]+/")  # of which the figures say the newest


class EpisodeFacts:
    """The episodes of a run, as its episodes.csv grows.

    count: those that have ended. newest: the values of the last one by column, as text; empty before the first.
    curve: environment steps and mean return of the last 100 episodes, at evenly spaced episodes.
    """

    def __init__(self, folder: Path, most: int) -> None:
        self._file = GrowingTable(folder / RECORDS[0])
        self.curve: Thinned[list[float]] = Thinned(most)
        self._forget()

    def _forget(self) -> None:
        self.count = 0
        self.newest: dict[str, str] = {}
        self._returns: deque[float] = deque(maxlen=RETURN_WINDOW)
        self.curve.clear()

    def refresh(self) -> None:
        """Read the new lines."""
        rows = list(self._file.rows())
        if self._file.restarted:
            self._forget()
        for row in rows:
            with suppress(KeyError, ValueError):
                step, episode_return = float(row["env_step"]), float(row["return"])
                self.count, self.newest = self.count + 1, row
                self._returns.append(episode_return)
                self.curve.add([step, self.mean])

    @property
    def mean(self) -> float:
        """Mean return of the last 100 episodes; 0 before the first."""
        return sum(self._returns) / len(self._returns) if self._returns else 0.0


class RunFolder:
    """A run as its files tell it; see `coop.monitor.watch.Followed`.

    Raises:
        UsageError: config.toml can't be read.
    """

    def __init__(self, path: Path) -> None:
        self.run, self.path = path.resolve().name, path
        self.learner: LearnerStatus | None = None
        self._config = read_run_config(path)
        self._episodes = EpisodeFacts(path, MAX_POINTS)
        self._metrics = GrowingFile(path / RECORDS[1])
        self._evaluations = Evaluations(path)
        self._log = next((GrowingFile(path / name) for name in LOGS if (path / name).exists()), None)
        self._events: deque[tuple[int, str]] = deque(maxlen=RECENT)
        self._said = 0
        self._row: dict[str, Any] = {}
        self._new: list[dict[str, float]] = []
        self._seconds = 0.0  # of learning: the rows' updates by their speeds, without the time between resumptions
        self._over = ""

    def refresh(self) -> None:
        """See `Followed`."""
        self._read_metrics()
        self._episodes.refresh()
        for line in self._log.lines() if self._log is not None else ():
            if line and not _PROGRESS.match(line):
                self._said += 1
                self._events.append((self._said, line))
        who, at_work = holder(self.path)
        try:
            summary = read_summary(self.path)
        except RunError as error:
            summary = {"exit": str(error)}
        self._over = "" if at_work else str(summary.get("exit", "")) or "no process works in its folder"
        self.learner = self._status(_HOLDER.fullmatch(who), summary)

    def events(self) -> Sequence[tuple[int, str]]:
        """See `Followed`: the newest lines of the log, if there is one."""
        return self._events

    def loss(self) -> str:
        """See `Followed`; a killed run is over."""
        return ""

    def silent_for(self) -> float:
        """See `Followed`; files are silent for as long as 200 updates take."""
        return 0.0

    def over(self) -> str:
        """See `Followed`."""
        return self._over

    def points(self) -> list[dict[str, float]]:
        """See `Followed`."""
        new, self._new = self._new, []
        return new

    def evaluations(self) -> list[Point]:
        """See `Followed`."""
        return self._evaluations.points()

    def line(self) -> str:
        """See `Followed`."""
        return (
            "nothing read yet" if self.learner is None else stamped(progress_line(msgspec.structs.asdict(self.learner)))
        )

    def _read_metrics(self) -> None:
        lines = self._metrics.lines()
        if self._metrics.restarted:
            self._row, self._seconds = {}, 0.0
        for line in lines:
            try:
                row = parse_row(line, "")
                updates, before = int(row["update"]), int(self._row.get("update", 0))
                if row["updates_per_s"]:
                    self._seconds += (updates - before) / row["updates_per_s"]
            except (RunError, KeyError, TypeError, ValueError):
                continue  # who resumes or reports the run names it
            self._row = row
            self._new.append(self._known(row))

    def _known(self, row: dict[str, Any]) -> dict[str, float]:
        """A row's metrics by name, as a status would tell them."""
        found = {m.name: row[m.column] for m in METRICS if m.field and not m.listed and m.column in row}
        ratio = {"ratio_target": self._config.replay.ratio, "ratio_measured": self._ratio(row)}
        known = {**found, "env_steps": row["env_step"], **ratio}
        return {name: value for name, value in known.items() if isinstance(value, int | float)}

    def _ratio(self, row: dict[str, Any]) -> float | None:
        """Updates per environment step since the first update was due."""
        steps = row["env_step"] - self._config.replay.learning_starts
        return row["update"] / steps if steps > 0 else None

    def _status(self, who: re.Match[str] | None, summary: dict[str, Any]) -> LearnerStatus:
        config, row, episodes = self._config, self._row, self._episodes
        steps = max(int(row.get("env_step", 0)), int(float(episodes.newest.get("env_step", 0))))
        steps, updates = int(summary.get("env_steps", steps)), int(summary.get("updates", row.get("update", 0)))
        speed, members = 0.0 if self._over else float(row.get("env_steps_per_s") or 0), []
        if who is not None:
            state = "lost" if self._over else "training"
            members = [Member(who[1], "learner", who[2], int(who[3]), state)]
        last = {name: float(episodes.newest.get(name) or 0) for name in ("epsilon", "s")}
        return LearnerStatus(
            env_steps=steps,
            total_steps=config.total_steps,
            updates=updates,
            updates_per_s=0.0 if self._over else float(row.get("updates_per_s") or 0),
            acting=int(row.get("acting", 1)),
            episodes=episodes.count,
            return_mean_100=episodes.mean,
            epsilon=float(row.get("epsilon") or last["epsilon"]),
            s=float(row.get("s") or last["s"]),
            waiting="",
            connected={},
            warning="",
            missing=[],
            events=list(self._events),
            origin=who[0] if who else "",
            env=config.env.id,
            method=config.method,
            seed=config.seed,
            seconds=float(summary.get("wall_seconds", self._seconds)),
            seconds_left=(config.total_steps - steps) / speed if speed else None,
            env_steps_per_s=speed,
            two_networks=config.two_networks,
            updates_to_swap=config.swap_period - updates % config.swap_period,
            size=int(row.get("replay_size", 0)),
            capacity=config.replay.capacity,
            return_history=[mean for _, mean in episodes.curve.points],
            ratio=Ratio(config.replay.ratio, self._ratio(row) if row else None),
            members=members,
            measured=Measured(**{name: finite(row[name]) for name in MEASURED if name in row}) if row else None,
        )
