"""The runs of the dissection as one small Parquet file: results/cartpole/edl/dissection.parquet.

A row is a run, with its areas, its running mean at CURVE moments and its gradients' ratios; or, with the phase
"layers", what a measure of a layer is over the runs of a cell at one moment. The schema's metadata hold the plan's
SHA-256 and the rates that the tuning chose.
"""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from coop.common.numbers import running_mean

PLAN, RATE_FILE = "plan.md", "rates.json"
NAMES = {"transform": "transform-constant", "matched": "rates"}  # the plan's names, where the program's differ
CURVE = 40  # moments of the running mean
MOMENTS = (0, 4, 9, -1)  # of the 20 measurements: the first, fifth, tenth and last
WARM_UP = 128  # steps before the first update: a run that has no finite measurement is held from there
THRESHOLD, FALLEN, SHORT, LAST = 195, 150, 20, 100  # of CartPole, as `coop.studies.report.learning` has them
SEAL = b"dissection"

Floats = NDArray[np.float64]


def curve_of(env_step: Floats, returns: Floats, steps: int) -> Floats:
    """The running mean of 100 episodes at each environment step; before the first episode's end, its return."""
    means = np.concatenate((returns[:1], running_mean(returns)))
    return np.asarray(means[np.searchsorted(env_step, np.arange(steps), side="right")])


def held_from(measured: NDArray[np.bool_], points: NDArray[np.int64]) -> int:
    """The last step at which a diverged run was measured and was finite; measured: bool [points]."""
    broken = np.flatnonzero(~measured)
    last = len(points) if not len(broken) else broken[0]
    return int(points[last - 1]) if last else WARM_UP


def summary(env_step: Floats, returns: Floats, steps: int, held: int | None) -> dict[str, Any]:
    """A run's outcomes. held: the step from which a diverged run counts with its last value."""
    curve = curve_of(env_step, returns, steps)
    end = int(env_step[-1])
    found = {"recorded": float(curve[:end].mean())}
    if held is not None:
        curve[held:] = curve[held]
    short = running_mean(returns, SHORT)[SHORT - 1 :]
    reached = np.flatnonzero(short >= THRESHOLD)
    collapses, healthy = 0, False
    for mean in short:
        if mean >= THRESHOLD:
            healthy = True
        elif healthy and mean < FALLEN:
            collapses, healthy = collapses + 1, False
    every = steps // CURVE
    return found | {
        "area": float(curve[:end].mean()),
        "last": float(returns[-LAST:].mean()),
        "steps_to": float(env_step[SHORT - 1 + reached[0]]) if len(reached) else math.inf,
        "collapses": collapses,
        "curve": np.round(curve[every - 1 :: every]).astype(np.int16),
    }


def runs_of(file: Path) -> Iterator[dict[str, Any]]:
    """A row for each run of a stack's file; tuning runs have their areas only."""
    about, data = _load(file)
    ends, measures = np.cumsum(data["counts"]), data["measures"]  # [points, names, K, layers]
    phase = file.name.split("-")[0]
    for row, (start, end) in enumerate(zip(ends - data["counts"], ends, strict=True)):
        finite = bool(data["finite"][row])
        held = None if finite else held_from(np.isfinite(measures[:, 0, row]).all(1), data["points"])
        steps, returns = (data[name][start:end].astype(float) for name in ("env_step", "returns"))
        outcomes = summary(steps, returns, about["steps"], held)
        where = {
            "phase": phase, "condition": NAMES.get(about["condition"], about["condition"]), "depth": about["depth"],
            "optimizer": str(data["optimizer"][row]), "seed": int(data["seed"][row]), "rate": float(data["rate"][row]),
            "finite": finite, "held": held, "device": about["device"],
        }  # fmt: skip
        if phase == "tuning":
            yield where | {name: outcomes[name] for name in ("area", "recorded")}
            continue
        norm, ratio = (measures[list(MOMENTS), number, row].astype(float) for number in (0, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            plain, driven = norm[:, 0] / norm[:, -1], (norm * ratio)[:, 0] / (norm * ratio)[:, -1]
        yield where | outcomes | {"plain": _short(plain), "driven": _short(driven)}


def layers_of(file: Path) -> Iterator[tuple[tuple[str, int, str], dict[str, Any]]]:
    """The measures of each optimizer's runs of a study's stack, [moments, names, runs, layers], by cell."""
    about, data = _load(file)
    condition = NAMES.get(about["condition"], about["condition"])
    for name in dict.fromkeys(data["optimizer"].tolist()):
        runs = data["optimizer"] == name
        yield (
            (condition, about["depth"], name),
            {"names": about["names"], "of": data["measures"][list(MOMENTS)][:, :, runs]},
        )


def pack(out: Path, path: Path, plan: Path) -> int:
    """Write the runs of the folder `out` into one Parquet file; return their number."""
    files = [file for file in sorted(out.glob("*-*.npz")) if not file.name.endswith(".part.npz")]
    rows = [row for file in files for row in runs_of(file)]
    cells: dict[tuple[str, int, str], list[Any]] = {}
    names: list[str] = []
    for file in files:
        if file.name.startswith("study-"):
            for cell, found in layers_of(file):
                names = found["names"]
                cells.setdefault(cell, []).append(found["of"])
    count = len(rows)
    for (condition, depth, optimizer), parts in cells.items():
        values = np.concatenate(parts, axis=2).astype(float)
        values[~np.isfinite(values)] = np.nan
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a cell of which all runs have diverged
            low, middle, high = np.nanpercentile(values, [5, 50, 95], axis=2)  # each [moments, names, layers]
        where = {"phase": "layers", "condition": condition, "depth": depth, "optimizer": optimizer}
        rows += [
            where | {
                "measure": name, "moment": moment, "low": _short(low[moment, number]),
                "median": _short(middle[moment, number]), "high": _short(high[moment, number]),
            }
            for moment in range(len(MOMENTS))
            for number, name in enumerate(names)
        ]  # fmt: skip
    frame = pd.DataFrame(rows).astype({"area": np.float32, "recorded": np.float32, "last": np.float32})
    rates = (out / RATE_FILE).read_text() if (out / RATE_FILE).exists() else "{}"
    about = {"plan": registered(plan), "rates": json.loads(rates)}
    table = pa.Table.from_pandas(frame, preserve_index=False).replace_schema_metadata({SEAL: json.dumps(about)})
    pq.write_table(table, path, compression="zstd", compression_level=22)
    return count


def registered(plan: Path) -> str:
    """The SHA-256 of a plan as it began; what changes later stands below its heading Changes."""
    return hashlib.sha256(plan.read_bytes().split(b"\n## Changes")[0]).hexdigest()


def unpacked(path: Path) -> tuple[pd.DataFrame, Mapping[str, Any]]:
    """The rows of a packed file, and its "plan" and "rates"."""
    table = pq.read_table(path)
    return table.to_pandas(), json.loads(table.schema.metadata[SEAL])


def _load(file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    with np.load(file) as held:
        data = {name: held[name] for name in held.files}
    return json.loads(str(data["about"])), data


def _short(values: Floats) -> NDArray[np.float32]:
    """Three digits of each; float32."""
    return np.array([float(f"{value:.3g}") for value in values.ravel()], np.float32)
