"""Whole runs in made-up time, with faults from a seed: `benchmarks/simulate`."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from benchmarks.simulate.plan import KINDS, Fault, make_plan
from benchmarks.simulate.planted import PLANTED, planted
from benchmarks.simulate.runner import Outcome, explain, find, shrink, simulate

SEEDS = 300
AT_ONCE = 25


def _assert_holds(outcome: Outcome) -> None:
    assert not outcome.problem, explain(outcome)


@pytest.mark.parametrize("first", range(0, SEEDS, AT_ONCE))
def test_no_fault_breaks_a_promise(first: int) -> None:
    met: Counter[str] = Counter()
    for seed in range(first, first + AT_ONCE):
        outcome = simulate(seed)
        _assert_holds(outcome)
        assert outcome.checks["order"], "updates were made"
        met += outcome.met
    assert len(met) > len(KINDS) / 2


def test_the_same_seed_is_the_same_run() -> None:
    one, two = (simulate(9, words=True) for _ in range(2))
    _assert_holds(one)
    assert one.trace == two.trace
    assert one.events == two.events > 300
    assert simulate(10, words=True).trace != one.trace


def test_a_planted_bug_is_found_said_and_made_small() -> None:
    _assert_holds(simulate(2))
    with planted("only-newest-part"):
        found = simulate(2)
        small = shrink(found)
        text = explain(small, "only-newest-part")
    assert small.problem.startswith("checkpoint: ")
    assert 1 <= len(small.plan.faults) < len(found.plan.faults)
    assert "python -m benchmarks.simulate --seed 2 --planted only-newest-part" in text
    assert str(small.plan.faults[0]) in text


@pytest.mark.parametrize("bug", ["skipped-batch", "short-window", "any-run"])
def test_other_planted_bugs_are_found(bug: str) -> None:
    count, found = find(bug, 0, 60)
    assert found is not None, f"{PLANTED[bug][0]}: not found in {count} seeds"


def test_time_passes_without_faults() -> None:
    plan = replace(make_plan(5), faults=(), journal="off")
    outcome = simulate(5, plan)
    _assert_holds(outcome)
    assert outcome.simulated < 20.0


def test_a_machine_that_dies_loses_only_what_no_promise_covers() -> None:
    crash = (Fault(1.0, "crash", "replay"), Fault(3.0, "crash", "learner"))
    for journal in ("sync", "async"):
        for seed in range(3):
            outcome = simulate(seed, replace(make_plan(seed), faults=crash, journal=journal, every=0.2))
            _assert_holds(outcome)
            assert outcome.met["crash"] > 0
            assert not outcome.forgiven or journal == "async"


@pytest.mark.parametrize("seed", [174, 463])
def test_a_disk_that_fails_a_flush_and_dies_loses_nothing_acknowledged(seed: int) -> None:
    outcome = simulate(seed)
    _assert_holds(outcome)
    assert outcome.plan.journal == "sync"
    assert outcome.met["bad flush"] == outcome.met["crash"] == 1
    assert not outcome.forgiven


@pytest.mark.parametrize("away", ["freeze", "kill", "partition"])
def test_a_second_learner_on_the_same_folder_waits_for_the_first_one_s_end(away: str) -> None:
    faults = (
        Fault(1.0, away, "learner", "replay", length=3.0),
        Fault(1.1, "second learner", "learner", "on the same folder"),
    )
    outcome = simulate(0, replace(make_plan(0), faults=faults, total=96, every=0.1), words=True)
    _assert_holds(outcome)
    refused = any("learner second 1 ends: RunError: /learner/run: learner uses it" in line for line in outcome.trace)
    assert refused == (away != "kill")
    assert outcome.checks["one learner"] >= 2 - refused


def test_a_learner_of_another_run_of_the_same_name_is_refused() -> None:
    faults = (Fault(1.0, "second learner", "learner", "elsewhere", 4.0),)
    outcome = simulate(0, replace(make_plan(0), faults=faults, total=96, every=0.1), words=True)
    _assert_holds(outcome)
    ends = [line for line in outcome.trace if "learner second 1 ends: Refused: run: 'run#" in line]
    assert len(ends) == 1
    assert outcome.checks["one run"] > 0


def test_a_flush_that_outlives_the_confirmation_acknowledges_nothing() -> None:
    faults = (
        Fault(0.5, "slow", "replay", length=5.0, number=3.0),
        Fault(0.7, "partition", "replay", "learner", 4.0),
        Fault(0.8, "second", "replay", "elsewhere"),
    )
    plan = replace(make_plan(0), faults=faults, journal="sync", every=0.1, total=96, actors=2)
    _assert_holds(simulate(0, plan))
    with planted("late-acknowledgement"):
        assert simulate(0, plan).problem.startswith("one service: ")
