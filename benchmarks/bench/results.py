"""The figures of `make bench`: kept as JSON, shown as tables of medians and ranges, and compared with earlier ones."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from bench import processor
from bench.areas import TARGETS, Target
from bench.comparison import Comparison, Rounds, python_of

FIGURES = Path(__file__).parents[1] / "results.json"
PAGE = Path(__file__).parents[1] / "RESULTS.md"
PACKAGES = {
    "bench": ("coop-rl", "torch", "numpy", "eclipse-zenoh", "stable-baselines3", "torchrl", "cpprb", "gymnasium"),
    "jax": ("jax", "jaxlib", "flax", "optax", "rejax", "gymnax", "numpy"),
    "reverb": ("dm-reverb", "tensorflow", "numpy"),
}
_PRINT_VERSIONS = """
import contextlib, importlib.metadata, sys
for name in sys.argv[1:]:
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        print(name, importlib.metadata.version(name))
"""
UNIT_COST = "us a unit"  # of the area growth
# How far apart ranges may lie that count as overlapping: of memory, which is measured once in a run, and of the rest.
MEMORY, SAME_MEMORY, SAME = ("MiB", "bytes/transition"), 1.05, 1.01
# "comparisons", by title: area, reference, seconds, "on", which of "machines", and "subjects": {name: Rounds}
Figures = dict[str, Any]


def load(path: Path) -> Figures:
    """The figures of a file; none if there is no such file."""
    found: Figures = json.loads(path.read_text()) if path.exists() else none()
    return found


def none() -> Figures:
    """No figures yet."""
    return {"machines": [], "comparisons": {}}


def save(figures: Figures, path: Path) -> None:
    """Write the figures to a file, with the rounds of a measure on one line."""
    text = re.sub(r"(?<=\[)[^\[\]{}]*(?=\])", lambda found: " ".join(found[0].split()), json.dumps(figures, indent=1))
    path.write_text(f"{text}\n")


def add(figures: Figures, comparison: Comparison, measured: dict[str, Rounds]) -> None:
    """Put a comparison's figures in the place of its earlier ones."""
    here = {"machine": machine(), "versions": versions()}
    put(figures, comparison, measured, here)


def put(figures: Figures, comparison: Comparison, measured: dict[str, Rounds], here: dict[str, Any]) -> None:
    """`add`, measured on the machine `here`; machines of which no figure is left are forgotten."""
    before, found = figures["machines"], figures["comparisons"]
    others = [old for title, old in found.items() if title != comparison.title]
    kept = [each for number, each in enumerate(before) if any(old["on"] == number for old in others)]
    for old in others:
        old["on"] = kept.index(before[old["on"]])
    figures["machines"] = kept if here in kept else [*kept, here]
    found[comparison.title] = {
        "area": comparison.area,
        "on": figures["machines"].index(here),
        "reference": comparison.reference,
        "seconds": comparison.seconds,
        "subjects": {
            name: {measure: [float(f"{value:.4g}") for value in values] for measure, values in rounds.items()}
            for name, rounds in measured.items()
        },
        "commands": {name: asdict(subject) for name, subject in comparison.subjects.items()},
    }


def machine() -> dict[str, str]:
    """Processor and its instructions, cores, memory, system and Python; the GPU, if there is one."""
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    return {
        "processor": processor.model(),
        "instructions": processor.instructions(),
        "cores": str(os.cpu_count()),
        "memory": f"{pages:.0f} GiB",
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        **processor.gpu(),
    }


def versions() -> dict[str, dict[str, str]]:
    """By environment in .bench/, the versions of the packages that it has."""
    return {venv: _versions(venv, names) for venv, names in PACKAGES.items() if python_of(venv).exists()}


def _versions(venv: str, names: tuple[str, ...]) -> dict[str, str]:
    command = [python_of(venv), "-c", _PRINT_VERSIONS, *names]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return dict(line.split() for line in done.stdout.splitlines())


def ratios(over: list[float], under: list[float]) -> list[float]:
    """Of the same rounds."""
    return [a / b for a, b in zip(over, under, strict=True)]


def spread(values: list[float]) -> str:
    """Median (lowest to highest), with three digits."""
    return f"{_short(median(values))} ({_short(min(values))} to {_short(max(values))})"


def _short(value: float) -> str:
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.{1 if abs(value) >= 10 else 2}f}"


def reached(target: Target, figures: Figures) -> tuple[str, list[float]] | None:
    """The subject that the target is measured by, if any, and the figures by round; None if they were not measured."""
    subjects = figures["comparisons"].get(target.comparison, {}).get("subjects", {})
    if not {target.over, *target.under} <= set(subjects):
        return None
    if not target.under:
        return "", subjects[target.over][target.measure]
    best = (min if target.at_most else max)(target.under, key=lambda name: median(subjects[name][target.measure]))
    return best, ratios(subjects[target.over][target.measure], subjects[best][target.measure])


def page(figures: Figures) -> str:
    """The page of all figures, in Markdown."""
    return "\n".join(_lines(figures)) + "\n"


def _lines(figures: Figures) -> Iterator[str]:
    yield "# Side by side\n"
    yield (
        "`make bench` writes this page from `results.json`. Subjects take turns in one run; a cell is the median over "
        "the rounds (lowest to highest), and a ratio is that of the same round. Subjects of one process "
        "have one thread and share one core, but whole runs to a return have a core each; their rates count "
        "seconds of processor time, those of several processes the clock's. A command is a script of "
        "`bench/subjects/`, which `.bench/bench/bin/python` runs, or that of `.bench/reverb` for Reverb.\n"
    )
    for number, here in enumerate(figures["machines"], start=1):
        facts = [f"{name}: {value}" for name, value in here["machine"].items()]
        for venv, packages in here["versions"].items():
            facts.append(f"`.bench/{venv}`: " + ", ".join(f"{name} {version}" for name, version in packages.items()))
        yield f"{number}. " + "; ".join(facts) + "."
    yield ""
    yield "## Targets\n"
    yield "| what | over | figure | target | |"
    yield "| --- | --- | --- | --- | --- |"
    for target in TARGETS:
        if found := reached(target, figures):
            best, values = found
            met = median(values) <= target.bound if target.at_most else median(values) >= target.bound
            bound = f"{'at most' if target.at_most else 'at least'} {_short(target.bound)}"
            what = f"{target.comparison}: {target.over}, {target.measure}"
            yield f"| {what} | {best} | {spread(values)} | {bound} | {'met' if met else 'short'} |"
    shown = set()
    for title, found in figures["comparisons"].items():
        yield f"\n## {title[0].upper()}{title[1:]}\n"
        where = f" on machine {found['on'] + 1}" if len(figures["machines"]) > 1 else ""
        yield f"`make bench AREAS={found['area']}`{where}.\n"
        yield from _tables(found)
        if found["area"] == "growth":
            yield "\n" + "; ".join(exponents(found["subjects"])) + "."
        if (area := found["area"]) not in shown:
            shown.add(area)
            yield f"\n![The ratios of the area {area}](plots/{area}.png)"


def reference(found: dict[str, Any]) -> Rounds:
    """What the reference did, without measures that were 0 in some round: they have no ratio."""
    rounds: Rounds = found["subjects"][found["reference"]]
    return {measure: values for measure, values in rounds.items() if all(values)}


def _tables(found: dict[str, Any]) -> Iterator[str]:
    measures = list(dict.fromkeys(name for rounds in found["subjects"].values() for name in rounds))
    base = reference(found)
    heads = ["", *(f"{name} | ratio" if name in base else name for name in measures), "command"]
    yield f"| {' | '.join(heads)} |"
    yield "| --- " * " | ".join(heads).count("|") + "| --- |"
    for subject, rounds in found["subjects"].items():
        cells = []
        for name in measures:
            values = rounds.get(name)
            cells.append(spread(values) if values else "")
            if name in base:
                cells.append(spread(ratios(values, base[name])) if values else "")
        command = found["commands"][subject]
        yield f"| {' | '.join([subject, *cells])} | `{' '.join([command['script'] + '.py', *command['arguments']])}` |"


def exponents(subjects: dict[str, Rounds]) -> Iterator[str]:
    """How the whole cost of each measure grows with the sizes that name the subjects: the fitted power of the size."""
    sizes = np.log([int(name.replace(",", "")) for name in subjects])
    for measure in next(iter(subjects.values())):
        costs = np.log([median(rounds[measure]) for rounds in subjects.values()])
        slope = np.polyfit(sizes, costs, 1)[0] + (measure == UNIT_COST)
        yield f"{'time' if measure == UNIT_COST else 'memory'} grows as size^{slope:.2f}"


def moved(new: Figures, old: Figures) -> Iterator[tuple[int, str]]:
    """For each ratio to the reference that both have, a line, and how it moved.

    -1: worse than before by more than both ranges, 1: better by more than both, 0: the ranges overlap, or almost.
    """
    for title, was in old["comparisons"].items():
        now = new["comparisons"].get(title)
        for subject, rounds in was["subjects"].items():
            for measure, values in rounds.items():
                measured = now["subjects"].get(subject, {}).get(measure) if now else None
                if not measured or subject == was["reference"] or measure not in reference(was).keys() & reference(now):
                    continue
                before = ratios(values, reference(was)[measure])
                after = ratios(measured, reference(now)[measure])
                same = SAME_MEMORY if measure in MEMORY else SAME
                rise = (min(after) > same * max(before)) - (same * max(after) < min(before))
                more_is_better = "/s" in measure or measure == "solved"
                line = f"{title}, {subject}, {measure}: {spread(after)} times the reference, was {spread(before)}"
                yield rise if more_is_better else -rise, line
