"""`make bench`: turns of real processes, ratios of rounds, the guard, and the committed page."""

import copy
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_command
from samples import until

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SUBJECT = """
import os
import subprocess
import sys
import time
from turns import attend, attend_rounds

if sys.argv[1] == "broken":
    sys.exit("it lacks a library")
taken = []

def turn(seconds):
    if sys.argv[1] == "long":
        child = subprocess.Popen(["sleep", "600"])
        print(child.pid, file=open(sys.argv[2], "w"), flush=True)
        child.wait()
    with open(sys.argv[2], "a") as file:
        print(sys.argv[1], seconds, *os.sched_getaffinity(0), file=file)
    taken.append(seconds)
    deadline = time.monotonic() + 20
    while sys.argv[1] == "waits" and len(open(sys.argv[2]).readlines()) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)  # for the same subject on the other core
    return {"work/s": 10.0 * len(taken)}

print("noise")
if sys.argv[1].startswith("round"):
    attend_rounds(lambda number: {"work/s": 10.0 * number, "cores": len(os.sched_getaffinity(0))})
attend(turn)
"""


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that imports a module of the benchmark."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    return lambda name: importlib.import_module(f"bench.{name}")


@pytest.fixture
def comparison(bench: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module that runs subjects, with a subject `own` and a virtual environment, this one."""
    module = bench("comparison")
    subjects = tmp_path / "bench" / "subjects"
    subjects.mkdir(parents=True)
    (subjects / "own.py").write_text(SUBJECT)
    (subjects.parent / "turns.py").symlink_to(BENCHMARKS / "bench" / "turns.py")
    folder = tmp_path / ".bench" / "bench" / "bin"
    folder.mkdir(parents=True)
    (folder / "python").write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    (folder / "python").chmod(0o755)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "SUBJECTS", subjects)
    return module


def test_subjects_take_turns(comparison: Any, tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    subjects = {name: comparison.Subject("own", (name, str(notes))) for name in ("a", "b")}
    found = comparison.compare(comparison.Comparison("x", "a and b", subjects, "a", seconds=0.5), 3, tmp_path)
    names, seconds, core = zip(*map(str.split, notes.read_text().splitlines()), strict=True)
    assert "".join(names) == "ababbaab", "a short one of each; then everybody is first in turn"
    assert seconds == ("0.25",) * 2 + ("0.5",) * 6
    assert set(core) == {"0"}
    assert found == {name: {"work/s": [20.0, 30.0, 40.0]} for name in ("a", "b")}, "the short turn does not count"


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_whole_tasks_run_abreast(comparison: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    subjects = {
        "a": comparison.Subject("own", ("round", "a")),
        "b": comparison.Subject("own", ("waits", str(tmp_path / "b"))),
        "all": comparison.Subject("own", ("round", "all"), cores=0),
    }
    whole = comparison.Comparison("x", "whole", subjects, "a", seconds=0.0, abreast=True)
    found = comparison.compare(whole, 3, tmp_path)
    assert found["a"] == {"work/s": [0.0, 10.0, 20.0], "cores": [1, 1, 1]}, "by round, whichever core took it"
    assert found["all"] == {"work/s": [0.0, 10.0, 20.0], "cores": [2, 2, 2]}
    assert len(list(tmp_path.glob("*-all-*.log"))) == 1, "one process of it"
    assert {line.split()[2] for line in (tmp_path / "b").read_text().splitlines()} == {"0", "1"}


def test_a_subject_that_ends_is_named(comparison: Any, tmp_path: Path) -> None:
    subjects = {"a": comparison.Subject("own", ("broken",))}
    with pytest.raises(
        comparison.SubjectError, match=r"^a ended \(exit status 1\): it lacks a library; see .*-a-0\.log$"
    ):
        comparison.compare(comparison.Comparison("x", "one", subjects, "a"), 1, tmp_path)


def test_a_subject_that_hangs_is_ended(comparison: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "LIMIT", 2.0)
    note = tmp_path / "child"
    subjects = {"a": comparison.Subject("own", ("long", str(note)))}
    with pytest.raises(comparison.SubjectError, match=r"^a took more than 2 s; see .*-a-0\.log$"):
        comparison.compare(comparison.Comparison("x", "one", subjects, "a"), 1, tmp_path)
    until(lambda: not _runs(int(note.read_text())))


@pytest.mark.parametrize("abreast", [False, True])
def test_an_interrupt_ends_long_turns(comparison: Any, abreast: bool, tmp_path: Path) -> None:
    note = tmp_path / "child"

    def interrupt() -> None:
        while not (note.exists() and note.read_text()):
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGUSR1)

    before = signal.signal(signal.SIGUSR1, signal.default_int_handler)
    subjects = {"a": comparison.Subject("own", ("long", str(note)), cores=0 if abreast else 1)}
    whole = comparison.Comparison("x", "whole", subjects, "a", seconds=0.0, abreast=abreast)
    try:
        threading.Thread(target=interrupt, daemon=True).start()
        with pytest.raises(KeyboardInterrupt):
            comparison.compare(whole, 2, tmp_path)
    finally:
        signal.signal(signal.SIGUSR1, before)
    until(lambda: not _runs(int(note.read_text())))


def test_an_interrupt_leaves_no_limit_behind(comparison: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[threading.Timer] = []

    class Interrupted(threading.Timer):
        def start(self) -> None:
            super().start()
            limits.append(self)
            raise KeyboardInterrupt

    monkeypatch.setattr(threading, "Timer", Interrupted)
    subjects = {"a": comparison.Subject("own", ("long", str(tmp_path / "child")))}
    with pytest.raises(KeyboardInterrupt):
        comparison.compare(comparison.Comparison("x", "one", subjects, "a"), 1, tmp_path)
    for limit in limits:
        limit.join(5)
        assert not limit.is_alive()


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _figures(**subjects: dict[str, list[float]]) -> dict[str, Any]:
    commands = {name: {"script": "own", "arguments": ["7", name]} for name in subjects}
    work = {"area": "x", "reference": "base", "subjects": subjects, "commands": commands}
    return {"comparisons": {"work": work}}


BASE = {"work/s": [10.0, 20.0, 10.0], "seconds": [1.0, 2.0, 1.0], "MiB": [10.0] * 3, "solved": [1.0, 0.0, 1.0]}
OURS = {"work/s": [20.0, 44.0, 18.0], "seconds": [0.5, 1.1, 0.4], "MiB": [5.0] * 3, "solved": [1.0, 1.0, 0.0]}


@pytest.mark.parametrize(
    ("changes", "way", "line"),
    [
        ({"work/s": [18.0, 36.0, 17.0]}, 0, "work/s: 1.80 (1.70 to 1.80) times the reference, was 2.00 (1.80 to 2.20)"),
        (
            {"work/s": [16.0, 35.0, 17.7]},
            -1,
            "work/s: 1.75 (1.60 to 1.77) times the reference, was 2.00 (1.80 to 2.20)",
        ),
        (
            {"work/s": [17.9, 35.8, 17.8]},
            0,
            "work/s: 1.79 (1.78 to 1.79) times the reference, was 2.00 (1.80 to 2.20)",
        ),
        (
            {"seconds": [0.552, 1.2, 0.6]},
            0,
            "seconds: 0.60 (0.55 to 0.60) times the reference, was 0.50 (0.40 to 0.55)",
        ),
        ({"work/s": [90.0, 90.0, 90.0]}, 1, "work/s: 9.00 (4.50 to 9.00) times the reference, was 2.00 (1.80 to 2.20)"),
        ({"work/s": [22.0, 90.0, 90.0]}, 0, "work/s: 4.50 (2.20 to 9.00) times the reference, was 2.00 (1.80 to 2.20)"),
        ({"seconds": [0.1, 0.1, 0.1]}, 1, "seconds: 0.10 (0.05 to 0.10) times the reference, was 0.50 (0.40 to 0.55)"),
        ({"seconds": [0.6, 1.3, 0.7]}, -1, "seconds: 0.65 (0.60 to 0.70) times the reference, was 0.50 (0.40 to 0.55)"),
        ({"MiB": [5.2] * 3}, 0, "MiB: 0.52 (0.52 to 0.52) times the reference, was 0.50 (0.50 to 0.50)"),
        ({"MiB": [5.3] * 3}, -1, "MiB: 0.53 (0.53 to 0.53) times the reference, was 0.50 (0.50 to 0.50)"),
    ],
)
def test_the_guard_names_what_left_its_range(bench: Any, changes: dict[str, list[float]], way: int, line: str) -> None:
    found = list(bench("results").moved(_figures(base=BASE, ours={**OURS, **changes}), _figures(base=BASE, ours=OURS)))
    assert (way, f"work, ours, {line}") in found
    assert [each for each, _ in found if each] == [way] * bool(way), "and nothing else"
    assert len(found) == 3, "the reference solved nothing in a round: no ratio"


def test_the_guard_passes_over_what_was_not_measured(bench: Any) -> None:
    moved, old = bench("results").moved, _figures(base=BASE, ours=OURS)
    assert not list(moved({"comparisons": {}}, old))
    assert not list(moved(_figures(base=BASE), old))


def test_the_guard_counts_and_fails_by_what_fell(
    bench: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command, module = bench("__main__"), bench("comparison")
    subjects = {name: module.Subject("own") for name in ("base", "ours")}
    monkeypatch.setattr(command, "COMPARISONS", [module.Comparison(command.AREAS[0], "work", subjects, "base")])
    monkeypatch.setattr(command, "add", lambda figures, _, measured: figures.update(_figures(**measured)))
    monkeypatch.setattr(sys, "argv", ["bench", "--against", str(tmp_path / "old.json")])
    (tmp_path / "old.json").write_text(json.dumps(_figures(base=BASE, ours=OURS)))
    for changes, said, status in (
        ({"seconds": [0.1] * 3}, ["better: work, ours, seconds", "of 3 ratios 2 agree", "1 are better, 0 worse"], 0),
        ({"work/s": [1.0] * 3}, ["worse: work, ours, work/s", "of 3 ratios 2 agree", "0 are better, 1 worse"], 1),
    ):
        measured = {"base": BASE, "ours": {**OURS, **changes}}
        monkeypatch.setattr(command, "compare", lambda *_, measured=measured: measured)
        with pytest.raises(SystemExit) as ended:
            command.main()
        words = capsys.readouterr().out
        assert all(each in words for each in said)
        assert ended.value.code == status


def test_figures_say_on_which_machine_they_were_measured(bench: Any) -> None:
    results, module = bench("results"), bench("comparison")
    machines = [{"machine": {"cores": cores}, "versions": {"bench": {"torch": "2"}}} for cores in ("1", "2")]
    figures = results.none()

    def measure(title: str, machine: int) -> list[str]:
        subjects = {"a": module.Subject("own")}
        results.put(figures, module.Comparison("x", title, subjects, "a"), {"a": {"s": [1.0]}}, machines[machine])
        return [
            line
            for line in results.page(figures).splitlines()
            if line.startswith(("## F", "## S", "`make bench A", "1. ", "2. "))
        ]

    one, two = (f"cores: {cores}; `.bench/bench`: torch 2." for cores in (1, 2))
    alone, first, second = (f"`make bench AREAS=x`{where}." for where in ("", " on machine 1", " on machine 2"))
    assert measure("first", 0) == [f"1. {one}", "## First", alone]
    assert measure("second", 0) == [f"1. {one}", "## First", alone, "## Second", alone]
    both = [f"1. {one}", f"2. {two}", "## First", second, "## Second", first]
    assert measure("first", 1) == both
    assert measure("first", 1) == both
    assert measure("second", 1) == [f"1. {two}", "## First", alone, "## Second", alone], "nothing is left of the other"
    back = [f"1. {two}", f"2. {one}", "## First", first, "## Second", second]
    assert measure("second", 0) == back, "and those that stay are numbered anew"


def test_versions_are_those_of_the_packages_that_an_environment_has(
    bench: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = bench("results")
    pythons = {"own": Path(sys.executable), "missing": tmp_path / "python"}
    monkeypatch.setattr(results, "python_of", pythons.get)
    monkeypatch.setattr(results, "PACKAGES", dict.fromkeys(pythons, ("no-such-package", "pytest")))
    assert results.versions() == {"own": {"pytest": pytest.__version__}}


def test_a_target_is_measured_by_the_best_of_the_others(bench: Any) -> None:
    results, target = bench("results"), bench("areas").Target
    figures = _figures(ours={"work/s": [9.0, 8.0]}, one={"work/s": [3.0, 2.0]}, two={"work/s": [1.0, 1.0]})
    assert results.reached(target("work", "work/s", "ours", ("one", "two"), 2.0), figures) == ("one", [3.0, 4.0])
    fastest = target("work", "work/s", "ours", ("one", "two"), 2.0, at_most=True)
    assert results.reached(fastest, figures) == ("two", [9.0, 8.0])
    assert results.reached(target("work", "work/s", "ours", ("one", "third"), 2.0), figures) is None


def test_a_target_without_others_is_a_figure(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    results, target = bench("results"), bench("areas").Target
    figures = {"machines": [], **_figures(base={"seconds": [2.5, 2.0, 2.9]})}
    targets = [target("work", "seconds", "base", (), bound, at_most=True) for bound in (2.6, 2.4)]
    assert results.reached(targets[0], figures) == ("", [2.5, 2.0, 2.9])
    assert results.reached(target("work", "seconds", "ours", (), 2.0), figures) is None
    monkeypatch.setattr(results, "TARGETS", targets)
    page = results.page(figures).splitlines()
    assert "| base | 2.50 (2.00 to 2.90) | 1.00 (1.00 to 1.00) | `own.py 7 base` |" in page
    lines = [line for line in page if line.startswith("| work: base")]
    assert lines == [
        "| work: base, seconds |  | 2.50 (2.00 to 2.90) | at most 2.60 | met |",
        "| work: base, seconds |  | 2.50 (2.00 to 2.90) | at most 2.40 | short |",
    ]


def test_the_cost_of_growing_work(bench: Any) -> None:
    subjects = {"10": {"us a unit": [2.0], "MiB": [5.0]}, "1,000": {"us a unit": [20.0], "MiB": [50.0]}}
    assert list(bench("results").exponents(subjects)) == ["time grows as size^1.50", "memory grows as size^0.50"]


def test_the_committed_page_shows_the_committed_figures(bench: Any) -> None:
    results = bench("results")
    figures = results.load(results.FIGURES)
    assert results.PAGE.read_text() == results.page(figures)
    other = copy.deepcopy(figures)
    other["comparisons"]["replay service"]["subjects"]["coop tcp"]["batches/s alone"][0] *= 2
    assert results.page(other) != results.PAGE.read_text()


def test_every_area_has_a_name_that_can_be_asked_for(bench: Any) -> None:
    areas = bench("areas")
    titles = [comparison.title for comparison in areas.COMPARISONS]
    assert len(titles) == len(set(titles))
    for comparison in areas.COMPARISONS:
        assert comparison.reference in comparison.subjects
        for subject in comparison.subjects.values():
            assert (BENCHMARKS / "bench" / "subjects" / f"{subject.script}.py").exists()
    for target in areas.TARGETS:
        subjects = next(c.subjects for c in areas.COMPARISONS if c.title == target.comparison)
        assert {target.over, *target.under} <= set(subjects)


def test_a_machine_without_the_gpu_is_told_so_in_a_line(tmp_path: Path) -> None:
    flags = ["--inside", "--device", "cuda:99", "--methods", "dqn", "--minutes", "0.001", "--out", tmp_path / "out"]
    done = run_command(BENCHMARKS / "gpu_atari.py", *flags)
    assert done.returncode == 1
    assert done.stderr.startswith("gpu_atari: error: learner.device = 'cuda:99': ")
    assert done.stderr.count("\n") == 1


def test_the_methods_learn_a_game_in_turn_and_go_on_elsewhere(tmp_path: Path) -> None:
    """`make gpu-atari`, with tiny settings on the processor."""
    out = tmp_path / "out"
    tiny = ["--device", "cpu", "--emulators", "4", "--kind", "nips2013", "--starts", "40", "--least", "80"]
    program = BENCHMARKS / "gpu_atari.py"
    flags = [*tiny, "--minutes", "0.001", "--methods", "dqn", "coop", "--out"]
    found = []
    for place in (out, tmp_path / "elsewhere"):
        if place != out:
            shutil.copytree(out, place)
            with np.load(place / "coop-1.npz") as kept:
                arrays = {"theta": kept["theta"] + 1, "square": kept["square"]}
            np.savez_compressed(place / "coop-1.npz", **arrays)
            done = run_command(program, "--inside", *flags, place)  # in the environment that it prepares
        else:
            done = subprocess.run([sys.executable, program, *flags, place], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert "coop" in done.stdout.splitlines()[-2]
        found.append([json.loads((place / f"{method}.json").read_text()) for method in ("dqn", "coop")])
        assert (place / "curves.png").stat().st_size > 0
    for first, then in zip(*found, strict=True):
        assert (first["resumed"], then["resumed"]) == (0, 1)
        assert 0 < first["updates"] < then["updates"]
        assert then["updates"] == then["agent_updates"] == sum(then["optimizer_steps"])
        assert first["steps"] < then["steps"]
        assert first["updates"] == (first["steps"] - 40) // 4 + 1
    with np.load(out / "coop-1.npz") as before, np.load(tmp_path / "elsewhere" / "coop-1.npz") as after:
        np.testing.assert_allclose(after["theta"], before["theta"] + 1, atol=0.1)  # goes on from the file
    other = run_command(program, *flags, out, "--game", "breakout")
    assert other.returncode == 2
    assert "is of pong" in other.stderr
