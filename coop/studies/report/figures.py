"""The report's figures as data, from a study's runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from coop.common.numbers import running_mean
from coop.common.settings.methods import METHODS
from coop.studies.report.intervals import Interval, iqm_by_task, iqm_of
from coop.studies.report.measures import (
    by_episodes,
    by_steps,
    diagnostic,
    diagnostics_of,
    evaluated_by_steps,
    metrics_by_steps,
    q_gaps,
    rows_with,
)
from coop.studies.report.plots import Figure, Line, Panel
from coop.studies.report.slices import CAPACITY, along, counts, label, other_settings
from coop.studies.report.study import CHURN, Floats, Run, Setting, Study
from coop.studies.report.summaries import MOST_TICKS, aggregates, final_returns

RATE = "edl.rate"
MOST_PANELS = 9
RETURN = "mean return of 100 episodes"
BANDS = " Interquartile mean over runs, band: 95 % bootstrap interval over seeds (none for a single run)."
NETWORKS = {
    "archive_td_error": "|TD error| on old transitions",
    "archive_drift": "change of Q on old states",
    CHURN: "greedy actions changed in 100 updates of a network, share",
    "dormant_share": "share of dormant units",
    "effective_rank": "effective rank of the last hidden layer",
    "q_share": "mean |Q| / its bound",
    "terminal_share": "share of terminal transitions",
}
SHARES = frozenset({"evicted_unsampled", "dormant_share"})  # drawn from 0 to 1; others are small
MEANING = (
    "On the first transitions drawn, which stay as they are; Q has changed since the last row of metrics, 200 updates "
    "before, of which each of two networks has half. The share of terminal transitions is that of the buffer."
)
Curve = Callable[[Sequence[Run]], tuple[Floats, Floats]]


def figures(study: Study) -> tuple[list[Figure], list[str]]:
    """All figures for which there are runs, and a line for each that cannot be shown, with the reason.

    The first one shows what the study has found.
    """
    ends, lacking = [], []
    if len(study.settings) <= MOST_TICKS:
        ends.append(final_returns(study))
    else:
        lacking.append(
            f"Return of the last 100 episodes: {len(study.settings)} settings are too many; the table has them all."
        )
    if study.index(CAPACITY) is None:
        lacking.append(f"Return against buffer size, breaking points: {CAPACITY} is the same in all finished runs.")
    else:
        ends = [buffers(study), *ends, diagnostics(study)]
    made = [*ends, returns_by_steps(study), returns_by_episodes(study)]
    if not study.one_scale:
        lacking.append(f"Aggregates over settings: returns of {', '.join(study.environments)} have different scales.")
    else:
        made += aggregates(study)
    if any(run.evaluated.size for run in study.runs):
        made.append(evaluations(study))
    made += [exploration(study), q_gap(study), *networks(study)]
    lacking += [f"{figure.title}: no run has the data for it." for figure in made if not _has_lines(figure)]
    return [figure for figure in made if _has_lines(figure)], lacking


def returns_by_episodes(study: Study) -> Figure:
    """Returns against episodes."""
    return _curves(
        study, "returns_episodes", "Returns against episodes", "episodes", RETURN,
        lambda runs: by_episodes([running_mean(run.returns) for run in runs]),
    )  # fmt: skip


def returns_by_steps(study: Study) -> Figure:
    """Returns against environment steps."""
    return _curves(
        study, "returns_steps", "Returns against environment steps", "environment steps", RETURN,
        lambda runs: by_steps(runs, [running_mean(run.returns) for run in runs]),
    )  # fmt: skip


def evaluations(study: Study) -> Figure:
    """Returns of greedy play against environment steps."""
    return _curves(
        study, "evaluations", "Returns of greedy play during training", "environment steps", "mean return",
        evaluated_by_steps, lambda run: run.evaluated.size > 0,
    )  # fmt: skip


def q_gap(study: Study) -> Figure:
    """The norm of Q1 - Q2 against episodes, for the methods with two trained networks."""
    title, y = "Norm of Q1 - Q2 against episodes", "mean norm on a fixed batch"
    return _curves(study, "q_gap", title, "episodes", y, q_gaps, _has_gaps, log_y=True)


def exploration(study: Study) -> Figure:
    """The exploration rate s against steps, and the returns at each rate."""
    place = study.index(RATE)
    settings = [study.reference]
    if place is not None:
        settings = [setting for setting in study.settings if _agree(setting, study.reference, place)]
    panels, used = [], []
    for method in (name for name in study.methods if METHODS.get(name).error_driven):
        groups = [(method if place is None else f"s = {s[place]}", study.of(method, s)) for s in settings]
        groups = [(text, runs) for text, runs in groups if runs]
        used += [run for _, runs in groups for run in runs]
        if groups:
            rates = [_line(text, *by_steps(runs, [run.s for run in runs])) for text, runs in groups]
            panels.append(Panel(f"{method}: s", "environment steps", "s", rates))
        if groups and place is not None:
            ends = [_line(text, *by_episodes([running_mean(run.returns) for run in runs])) for text, runs in groups]
            panels.append(Panel(f"{method}: returns", "episodes", RETURN, ends))
    text = "s is the paper's exploration rate, B = U (S + s I) V^T." + BANDS + _where(study, settings)
    return Figure("exploration", "Exploration rates", text, counts(used), panels)


def buffers(study: Study) -> Figure:
    """Return against buffer size, as the tables of settings have it."""
    panels = []
    for others in other_settings(study, CAPACITY):
        lines = []
        for method in study.methods:
            capacities, scores = along(study, CAPACITY, method, others)
            if capacities:
                at, ends = np.array(capacities, np.float64), np.array([iqm_of(each) for each in scores])
                lines.append(Line(method, at, Interval(*ends.T), dashed=method not in study.buffered))
        panels.append(Panel(_without(study, CAPACITY, others), "capacity", "return", lines, marks=True, sizes=True))
    text = (
        "Return of the last 100 episodes: interquartile mean over seeds and its 95 % bootstrap interval, as in the "
        "table of settings (none for a single run). Sizes at equal distances, methods beside each other at each."
    )
    if len(study.buffered) < len(study.methods):
        text += " Dashed: without a replay buffer, so that its runs are those of size 0 everywhere."
    text = f"{text} {study.eviction}".rstrip()
    title, used = "Return against buffer size", counts(study.runs)
    return Figure("buffers", title, text, used, panels, same_y=study.one_scale)


def diagnostics(study: Study) -> Figure:
    """Sample age, reuse and the share evicted unsampled against capacity."""
    names = {
        "sample_age_mean": "sample age, steps",
        "reuse_mean": "draws of a sample so far",
        "evicted_unsampled": "share evicted unsampled",
    }
    text = (
        "Mean over runs, of the second half of each run (share evicted: at its end); bars: least and largest run. "
        "With fifo and reservoir the buffer does not depend on the method, and the lines lie on each other. "
        f"{study.eviction}"
    )
    panels = _against_capacity(study, names, other_settings(study, CAPACITY)[:MOST_PANELS])
    return Figure("diagnostics", "What the buffer hands out", text, counts(study.runs), panels)


def networks(study: Study) -> list[Figure]:
    """Forgetting, plasticity and churn against environment steps and, if it varies, capacity; none without the data."""
    names = {name: words for name, words in NETWORKS.items() if name in diagnostics_of(study)}
    panels, used = [], []
    for name, words in names.items():
        lines = []
        for method in study.methods:
            runs = [run for run in study.of(method, study.reference) if len(rows_with(run, name)[1])]
            if runs:
                lines.append(_line(method, *metrics_by_steps(runs, name)))
                used += runs
        panels.append(Panel(words, "environment steps", words, lines, share=name in SHARES))
    shown = [run for run in study.runs if any(run is each for each in used)]
    text = f"{MEANING}{BANDS}{_where(study, [study.reference])}"
    made = [Figure("networks", "Forgetting, plasticity and churn", text, counts(shown), panels)] if shown else []
    place = study.index(CAPACITY)
    if names and place is not None:
        title = "Forgetting, plasticity and churn against buffer size"
        bars = "Mean over runs, of the second half of each run; bars: least and largest run."
        text = f"{MEANING} {bars} {study.eviction}"
        others = [study.reference[:place] + study.reference[place + 1 :]]
        panels = _against_capacity(study, names, others)
        made.append(Figure("networks_buffers", title, text, counts(study.runs), panels))
    return [figure for figure in made if _has_lines(figure)]


def _against_capacity(study: Study, names: Mapping[str, str], settings: Sequence[Setting]) -> list[Panel]:
    """A panel for each diagnostic at each setting of the other axes; names: the words for each."""
    panels = []
    for others in settings:
        for name, words in names.items():
            lines = []
            for method in study.buffered:
                capacities, values = along(study, CAPACITY, method, others, partial(diagnostic, name=name))
                points = [(c, v[~np.isnan(v)]) for c, v in zip(capacities, values, strict=True)]
                points = [(c, v) for c, v in points if len(v)]
                if points:
                    ends = [[v.mean() for _, v in points], [v.min() for _, v in points], [v.max() for _, v in points]]
                    at = np.array([c for c, _ in points], np.float64)
                    lines.append(Line(method, at, Interval(*map(np.array, ends))))
            title, share = _without(study, CAPACITY, others), name in SHARES
            panels.append(Panel(title, "capacity", words, lines, marks=True, sizes=True, share=share))
    return panels


def _curves(
    study: Study,
    name: str,
    title: str,
    x: str,
    y: str,
    curve: Curve,
    usable: Callable[[Run], bool] = lambda run: True,
    log_y: bool = False,
) -> Figure:
    settings, panels, used = _panel_settings(study), [], []
    for setting in settings:
        lines = []
        for method in study.methods:
            runs = [run for run in study.compared(method, setting) if usable(run)]
            if runs:
                lines.append(_line(method, *curve(runs)))
                used += runs
        if lines:
            panels.append(Panel(label(study, setting), x, y, lines, log_y=log_y))
    return Figure(name, title, BANDS.strip() + _where(study, settings), counts(used), panels, same_y=study.one_scale)


def _line(text: str, at: Floats, curves: Floats) -> Line:
    if len(curves) == 1:
        nothing = np.full(len(at), np.nan)
        return Line(text, at, Interval(curves[0], nothing, nothing))
    return Line(text, at, iqm_by_task(curves))


def _panel_settings(study: Study) -> list[Setting]:
    """All settings, or if there are too many, those that differ from the reference only in capacity."""
    place = study.index(CAPACITY)
    if len(study.settings) <= MOST_PANELS:
        return study.settings
    if place is None:
        return [study.reference]
    return [setting for setting in study.settings if _agree(setting, study.reference, place)]


def _agree(one: Setting, other: Setting, but: int) -> bool:
    return one[:but] + one[but + 1 :] == other[:but] + other[but + 1 :]


def _where(study: Study, shown: Sequence[Setting]) -> str:
    if len(shown) == len(study.settings):
        return ""
    fixed = [f"{axis} = {value}" for axis, value, *rest in zip(study.axes, *shown, strict=True) if set(rest) <= {value}]
    return f" {len(shown)} of {len(study.settings)} settings: {', '.join(fixed)}."


def _without(study: Study, axis: str, others: Setting) -> str:
    names = [name.rpartition(".")[2] for name in study.axes if name != axis]
    return ", ".join(f"{name} {value}" for name, value in zip(names, others, strict=True))


def _has_gaps(run: Run) -> bool:
    return run.config.two_networks and len(run.metrics["q_gap"]) > 0


def _has_lines(figure: Figure) -> bool:
    return any(panel.lines for panel in figure.panels)
