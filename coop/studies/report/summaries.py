"""Figures of how runs end: the return at every setting, and aggregates over settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from coop.studies.report.intervals import Interval, improvement, iqm_of, iqm_overall, profiles
from coop.studies.report.measures import score
from coop.studies.report.plots import Figure, Line, Panel
from coop.studies.report.slices import counts, label, matrices, pairs
from coop.studies.report.study import Floats, Setting, Study

MOST_TICKS = 30  # settings in one panel
SPREAD = 0.6  # of the space of one tick, taken by the methods

Points = Mapping[str, Mapping[int, tuple[float, float, float]]]  # value, low, high by line and tick


def final_returns(study: Study) -> Figure:
    """The returns at the end of the runs, at every setting."""
    place = study.index("env.id")
    groups: dict[str, list[Setting]] = {}
    for setting in study.settings:
        groups.setdefault("" if place is None else str(setting[place]), []).append(setting)
    panels = []
    for env, settings in groups.items():
        alone = len(settings) == 1
        ticks = study.methods if alone else [_without_env(study, each) for each in settings]
        found: dict[str, dict[int, Floats]] = {}
        for number, setting in enumerate(settings):
            for method in study.methods:
                scores = np.array([score(run) for run in study.of(method, setting)])
                if len(scores):
                    found.setdefault(method, {})[study.methods.index(method) if alone else number] = scores
        ends: dict[str, dict[int, tuple[float, float, float]]] = {}
        for method, at in found.items():
            ends[method] = {tick: iqm_of(scores) for tick, scores in at.items()}
        shifts = {} if alone else dodge(list(found))
        dots = [
            Line(
                method,
                np.concatenate([np.full(len(scores), tick + shifts.get(method, 0.0)) for tick, scores in at.items()]),
                _bare(np.concatenate(list(at.values()))),
                faint=True,
            )
            for method, at in found.items()
        ]
        panels.append(
            Panel(env, "", "return of the last 100 episodes", [*dots, *tick_lines(ends, shifts)], True, ticks=ticks)
        )
    text = (
        "Small dots: single runs; large ones: their interquartile mean, with its 95 % bootstrap interval over seeds "
        "(none for a single run)."
    )
    return Figure("final_returns", "Return of the last 100 episodes", text, counts(study.runs), panels)


def aggregates(study: Study) -> list[Figure]:
    """Interquartile means, probabilities of improvement and performance profiles over all shared settings."""
    scores = matrices(study)
    shapes = {name: (*matrix.shape, matrix.size) for name, matrix in scores.items()}
    seeds = "; ".join(f"{name}: {n} runs (seeds x settings: {s} x {t})" for name, (s, t, n) in shapes.items())
    means = [Line(name, np.array([float(at)]), iqm_overall(matrix)) for at, (name, matrix) in enumerate(scores.items())]
    better = [
        Line(f"{x} > {y}", np.array([float(at)]), improvement(scores[x], scores[y]))
        for at, (x, y) in enumerate(pairs(list(scores)))
    ]
    every = np.concatenate([matrix.ravel() for matrix in scores.values()]) if scores else np.zeros(1)
    levels = np.linspace(every.min() - 1e-9, every.max(), 61)
    shares = [Line(name, levels, interval) for name, interval in profiles(scores, levels).items()] if scores else []
    interval = " over the settings that all methods share; 95 % bootstrap intervals over seeds."
    names = [line.label for line in better]
    return [
        Figure(
            "iqm", "Interquartile mean of the return", f"Interquartile mean{interval}", seeds,
            [Panel("", "", "return", means, marks=True, ticks=list(scores))] if means else [],
        ),
        Figure(
            "improvement", "Probability of improvement",
            f"Probability that a run of the first returns more than one of the second{interval} 0.5: no difference.",
            seeds,
            [Panel("", "", "P(x > y)", better, True, share=True, ticks=names, reference=0.5)] if better else [],
        ),
        Figure(
            "profiles", "Performance profiles", f"Share of runs whose return is above a level{interval}", seeds,
            [Panel("", "return", "share of runs above", shares, share=True)] if shares else [],
        ),
    ]  # fmt: skip


def dodge(names: Sequence[str]) -> dict[str, float]:
    """How far from a tick each name's points are drawn, so that they do not cover each other."""
    if len(names) == 1:
        return {names[0]: 0.0}
    return {name: SPREAD * (place / (len(names) - 1) - 0.5) for place, name in enumerate(names)}


def tick_lines(points: Points, shifts: Mapping[str, float]) -> list[Line]:
    """Lines of points at ticks."""
    return [
        Line(name, np.array([tick + shifts.get(name, 0.0) for tick in at]), Interval(*np.array(list(at.values())).T))
        for name, at in points.items()
    ]


def _bare(values: Floats) -> Interval:
    nothing = np.full(len(values), np.nan)
    return Interval(values, nothing, nothing)


def _without_env(study: Study, setting: Setting) -> str:
    words = label(study, setting)
    place = study.index("env.id")
    return words if place is None else words.replace(f"id {setting[place]}", "").strip(", ") or "preset"
