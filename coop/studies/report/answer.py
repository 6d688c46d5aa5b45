"""What a study has found, in words: no more than its tables say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from coop.common.process.console import counted
from coop.studies.report.slices import label, seeds_of
from coop.studies.report.study import Study
from coop.studies.report.table import ResultTable, rounded

FEW = 5  # runs of a method at one setting, below which intervals say little
BEST = "the interquartile mean of the return of the last 100 episodes"


def answer(study: Study, tables: Sequence[ResultTable]) -> list[str]:
    """Sentences, with 95 % intervals in brackets."""
    by_name = {table.name: table for table in tables}
    told = [_subject(study)]
    if "baseline" in by_name:
        told += _baseline(by_name["baseline"])
    if study.one_scale:
        if len(study.methods) > 1:
            told += [*_methods(study, by_name["aggregate"]), _pairs(by_name["improvement"])]
        if "breaking_points" in by_name:
            told += _breaking(by_name["breaking_points"])
        elif len(study.settings) > 1:
            told += _settings(study, by_name["settings"])
    return [*told, *_doubts(study)]


def _subject(study: Study) -> str:
    total = len(study.runs) + len(study.missing)
    diverged = f", {len(study.diverged)} diverged" if study.diverged else ""
    methods, environments = ", ".join(study.methods), ", ".join(study.environments)
    told = f"{len(study.runs)} of {total} runs finished{diverged}: {methods} on {environments}, {_seeds(study)}"
    if not study.axes:
        return f"{told}; they differ by nothing but method and seed."
    values = [
        list(dict.fromkeys(str(setting[place]) for setting in study.settings)) for place in range(len(study.axes))
    ]
    axes = [f"{axis} ({', '.join(each)})" for axis, each in zip(study.axes, values, strict=True)]
    return f"{told}; they differ by {' and '.join(axes)}."


def _seeds(study: Study) -> str:
    seeds = seeds_of(study.runs)
    return f"seed {seeds}" if seeds.isdecimal() else f"seeds {seeds}"


def _methods(study: Study, table: ResultTable) -> list[str]:
    """The methods by their interquartile means over all shared settings."""
    rows = sorted(_rows(table), key=lambda row: -row["IQM"])
    if not rows:
        return [f"The methods share no setting and seed at which {BEST} could be compared."]
    where = "" if rows[0]["settings"] == 1 else f"Over the {rows[0]['settings']} settings that all methods share, "
    means = ", ".join(f"{row['method']} {_estimate(row, 'IQM')}" for row in rows)
    text = f"{where}{BEST} is: {means}."
    return [text[0].upper() + text[1:]]


def _pairs(table: ResultTable) -> str:
    """Which methods these runs tell apart."""
    told, apart = _rows(table), []
    for row in told:
        low, high = row["low"], row["high"]
        if low > 0.5:
            apart.append(f"{row['x']} returns more than {row['y']} with probability {_estimate(row, 'P(x > y)')}")
        elif high < 0.5:
            turned = {"P": 1 - row["P(x > y)"], "low": 1 - high, "high": 1 - low}
            apart.append(f"{row['y']} returns more than {row['x']} with probability {_estimate(turned, 'P')}")
    if not apart:
        return "These runs tell no two methods apart: every interval of the probability of improvement holds 0.5."
    rest = len(told) - len(apart)
    others = f" The other {rest} pairs they do not tell apart: the interval holds 0.5." if rest else ""
    others = " One other pair they do not tell apart: its interval holds 0.5." if rest == 1 else others
    return f"Of two runs, {'; '.join(apart)}.{others}"


def _breaking(table: ResultTable) -> list[str]:
    """The breaking points, a sentence for each slice of the other axes."""
    slices: dict[str, list[str]] = {}
    others = list(table.columns[: table.columns.index("method")])
    for row in _rows(table):
        where = ", ".join(f"{name.rpartition('.')[2]} {row[name]}" for name in others)
        point = "unknown" if row["breaking point"] is None else _estimate(row, "breaking point")
        slices.setdefault(where, []).append(f"{row['method']} {point}")
    largest = rounded(table.frame["largest"].max())
    return [
        f"Smallest buffer with 95 % of the return at {largest}{f', {where}' if where else ''}: {', '.join(points)}."
        for where, points in slices.items()
    ]


def _settings(study: Study, table: ResultTable) -> list[str]:
    """The setting at which each method returns most, and the ones that its interval tells apart from it."""
    told = []
    for method in study.methods:
        rows = [row for row in _rows(table) if row["method"] == method]
        rows = [row for row in rows if row["IQM low"] is not None]
        if len(rows) < 2:
            continue
        best = max(rows, key=lambda row: (float(rounded(row["IQM"])), row["IQM low"]))
        names = {id(row): label(study, tuple(row[axis] for axis in study.axes)) for row in rows}
        below = [names[id(row)] for row in rows if row["IQM high"] < best["IQM low"]]
        others = (
            f"the intervals of {', '.join(below)} end below it"
            if below
            else "the intervals of all others overlap with it"
        )
        estimate = _estimate(best, "IQM", "IQM low", "IQM high")
        told.append(f"{method}: {BEST} is highest at {names[id(best)]}, {estimate}; {others}.")
    return told


def _baseline(table: ResultTable) -> list[str]:
    """The differences from the baseline over all settings, or at each if there is no such row."""
    rows = [row for row in _rows(table) if row["measure"] == table.rows[0][0]]
    rows = [row for row in rows if row["setting"] == "all"] or rows
    places = ["" if row["setting"] == "all" else f" at {row['setting']}" for row in rows]
    estimates = [_estimate(row, "difference") for row in rows]
    told = ", ".join(
        f"{row['method']}{place} {estimate}" for row, place, estimate in zip(rows, places, estimates, strict=True)
    )
    return [f"{table.title}, return of the last 100 episodes over the same seeds: {told}."]


def _doubts(study: Study) -> list[str]:
    told = []
    fewest = min(len(study.of(method, at)) for method in study.methods for at in study.settings if study.of(method, at))
    if fewest < FEW:
        runs = "a single run" if fewest == 1 else f"{fewest} runs"
        told.append(f"Some settings have {runs}: intervals of so few cover less than 95 %, and prove nothing.")
    if study.warnings:
        runs = counted(len(study.warnings), "run")
        told.append(f"In {runs} mean |Q| exceeded its bound at times: do not trust such a run.")
    return told


def _rows(table: ResultTable) -> list[dict[str, Any]]:
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


def _estimate(row: Mapping[str, Any], name: str, low: str = "low", high: str = "high") -> str:
    bounds = [row[low], row[high]]
    if any(rounded(bound) == "-" for bound in bounds):
        return rounded(row[name])
    return f"{rounded(row[name])} [{', '.join(map(rounded, bounds))}]"
