"""All runs of a sweep as tables of pandas."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from coop.common.errors import UsageError
from coop.common.imports import check_extra
from coop.common.places import absolute
from coop.common.process.output import warn
from coop.common.settings.config import value_of
from coop.common.settings.overrides import leaves
from coop.common.settings.tables import identity, parse_run_config


@dataclass(frozen=True)
class SweepFrames:
    """The records of all runs that a sweep has begun, each row with the settings of its run.

    Attributes:
        episodes, metrics: the rows of episodes.csv and metrics.jsonl; in front of their columns stand `run`, the
            folder's name, `method`, `seed`, and the dotted names of the settings in which the runs differ.
    """

    episodes: pd.DataFrame
    metrics: pd.DataFrame

    def _repr_html_(self) -> str:
        shown = {"episodes": self.episodes, "metrics": self.metrics}
        return "".join(f"<p>{name}</p>{frame.to_html(max_rows=10)}" for name, frame in shown.items())


def load_sweep(folder: str | Path) -> SweepFrames:
    """Read the runs of a sweep, of any folder of runs, or of a packed study; runs that go on are included.

    A folder whose config can't be read is left out with a warning.

    Raises:
        UsageError: there is no run, or pyarrow (extra `report`) is not installed.
        RunError: a record can't be read.
    """
    check_extra("coop.load_sweep", "report", "pyarrow")
    from coop.studies.report.packed import CONFIG, EPISODES, METRICS  # noqa: PLC0415 (needs the extra)
    from coop.studies.report.sources import open_source  # noqa: PLC0415
    from coop.studies.report.study import runs_of  # noqa: PLC0415

    path = absolute(folder, "folder")
    if not path.exists():
        raise UsageError(f"folder {path}: does not exist")
    source = open_source(path)
    configs = {}
    for name in runs_of(source, path)[1]:
        try:
            if text := source.text(name, CONFIG):
                configs[name] = parse_run_config(text, f"{path}/{name}/{CONFIG}")
        except UsageError as error:
            warn(f"{error}; left out")
    if not configs:
        raise UsageError(f"{path}: holds no run")
    flat = [{".".join(place): value for place, value in leaves(identity(config))} for config in configs.values()]
    names = dict.fromkeys(name for each in flat for name in each)
    differing = [name for name in names if any(each.get(name) != flat[0].get(name) for each in flat)]
    axes = dict.fromkeys(("method", "seed", *differing))

    def settings(name: str) -> dict[str, Any]:
        values = {axis: value_of(configs[name], axis) for axis in axes}
        return {"run": name, **{axis: str(v) if isinstance(v, list | tuple) else v for axis, v in values.items()}}

    def table(file: str) -> pd.DataFrame:
        frames = {name: frame for name in configs if len(frame := source.table(name, file))}
        if not frames:
            return pd.DataFrame(columns=["run", *axes])
        records = pd.concat(frames.values(), ignore_index=True)
        rows = [row for name, frame in frames.items() for row in [settings(name)] * len(frame)]
        columns = {axis: [row[axis] for row in rows] for axis in ("run", *axes) if axis not in records}
        return pd.concat([pd.DataFrame(columns), records], axis=1)

    return SweepFrames(table(EPISODES), table(METRICS))
