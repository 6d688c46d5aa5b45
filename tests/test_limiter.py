"""The limiter keeps the ratio, never wedges, and says why it refuses."""

from __future__ import annotations

from dataclasses import asdict, replace
from math import floor
from random import Random

import msgpack
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coop.common.errors import UsageError
from coop.lockstep.lockstep import Lockstep
from coop.records.run_options import base_config
from coop.replay.core import ReplayCore
from coop.replay.limiter import RateLimiter

THOUSAND = RateLimiter(ratio=1.0, start=1000, tolerance=40, total=50_000)
QUARTER = RateLimiter(ratio=0.25, start=100, tolerance=10, total=None)


@pytest.mark.parametrize(
    ("limiter", "inserted", "drawn", "reason"),
    [
        (THOUSAND, 0, 0, None),
        (THOUSAND, 999, 0, None),
        (THOUSAND, 1040, 0, None),
        (THOUSAND, 1041, 0, "inserts are 41 steps ahead of updates"),
        (THOUSAND, 9000, 2000, "inserts are 6,000 steps ahead of updates"),
        (THOUSAND, 49_999, 48_999, None),
        (THOUSAND, 50_000, 49_000, "run complete: 50,000 of 50,000 steps"),
        (THOUSAND, 50_015, 100, "run complete: 50,000 of 50,000 steps"),
        (QUARTER, 110, 0, None),
        (QUARTER, 111, 0, "inserts are 11 steps ahead of updates"),
        (QUARTER, 111, 1, None),
    ],
)
def test_why_not_insert(limiter: RateLimiter, inserted: int, drawn: int, reason: str | None) -> None:
    assert limiter.why_not_insert(inserted, drawn) == reason


@given(
    ratio=st.sampled_from((0.125, 0.25, 1.0, 2.0, 8.0)),
    tolerance=st.integers(0, 64),
    inserted=st.integers(0, 300),
    more=st.integers(0, 50),
    changed=st.booleans(),
    total=st.sampled_from((None, 200)),
)
@example(ratio=1.0, tolerance=4, inserted=40, more=0, changed=False, total=None)  # the first step with draws
def test_below_which_number_draws_are_admitted(
    ratio: float, tolerance: int, inserted: int, more: int, changed: bool, total: int | None
) -> None:
    limiter = RateLimiter(ratio=ratio, start=40, tolerance=tolerance, total=total)
    if changed:
        limiter = limiter.changed(inserted, int(ratio * max(0, inserted - 40)), ratio=0.5)
    admitted = limiter.admitted(inserted)
    for drawn in range(max(0, admitted - 3), admitted + 3):
        assert (limiter.why_not_sample(inserted, drawn, 10) is None) == (drawn < admitted)
    assert limiter.admitted(inserted + more) >= admitted, "and it remains so"


def test_what_displays_show_of_the_ratio() -> None:
    assert QUARTER.measured(100, 0) is None
    assert QUARTER.measured(QUARTER.start + 1, 2) == 2.0
    assert (QUARTER.measured(300, 49), QUARTER.ahead(300, 49)) == (0.245, 4.0)
    assert (QUARTER.slack, replace(QUARTER, tolerance=1).slack) == (10, 2.0)
    changed = QUARTER.changed(300, 49, ratio=2.0)
    assert changed.measured(300, 49) is None
    assert (changed.measured(400, 251), changed.ahead(400, 251)) == (2.02, -1.0)


@pytest.mark.parametrize(
    ("limiter", "inserted", "drawn", "reason"),
    [
        (THOUSAND, 312, 0, "waiting for 1,000 transitions, have 312"),
        (THOUSAND, 1000, 0, None),
        (THOUSAND, 1000, 39, None),
        (THOUSAND, 1000, 40, "updates are 40 ahead of inserts"),
        (THOUSAND, 1100, 152, "updates are 52 ahead of inserts"),
        (THOUSAND, 50_000, 48_999, None),
        (THOUSAND, 50_000, 49_000, "run complete: 50,000 of 50,000 steps"),
        (THOUSAND, 49_990, 49_000, "updates are 10 ahead of inserts"),
        (QUARTER, 100, 1, None),
        (QUARTER, 100, 2, "updates are 2 ahead of inserts"),
        (replace(QUARTER, tolerance=2), 100, 0, "the next update is due in 2 steps"),
        (replace(QUARTER, tolerance=2), 102, 0, None),
        (replace(QUARTER, tolerance=2), 102, 1, "the next update is due in 4 steps"),  # half an update ahead
        (replace(QUARTER, tolerance=4), 100, 1, "updates are 1 ahead of inserts"),
    ],
)
def test_why_not_sample(limiter: RateLimiter, inserted: int, drawn: int, reason: str | None) -> None:
    assert limiter.why_not_sample(inserted, drawn, inserted) == reason


def test_an_empty_table_is_not_sampled() -> None:
    limiter = RateLimiter(1.0, start=0, tolerance=5, total=10)
    assert limiter.why_not_sample(0, 0, 0) == "waiting for transitions, the table is empty"
    assert limiter.why_not_insert(0, 0) is None


@st.composite
def limiters(draw: st.DrawFn) -> RateLimiter:
    total = draw(st.integers(0, 400))
    return RateLimiter(
        ratio=draw(st.floats(0.01, 8)),
        start=draw(st.integers(0, total)),
        tolerance=draw(st.one_of(st.just(0.0), st.floats(0, 100))),
        total=total,
    )


def check_kept(limiter: RateLimiter, inserted: int, drawn: int, longest: int) -> None:
    """The promise of the class, in updates, with 1e-6 for rounding."""
    if inserted < limiter.start:
        return
    first_inserted, first_drawn = limiter.origin or (limiter.start, 0)
    slack = max(limiter.tolerance, 0.5 / limiter.ratio) * limiter.ratio
    behind = limiter.ratio * (inserted - first_inserted) - (drawn - first_drawn)
    assert -slack - 1e-6 <= behind <= slack + longest * limiter.ratio + 1e-6


@settings(max_examples=3 * settings.default.max_examples)
@given(limiter=limiters(), steps=st.lists(st.integers(1, 64), min_size=1), order=st.randoms(use_true_random=False))
def test_any_run_completes_within_tolerance(limiter: RateLimiter, steps: list[int], order: Random) -> None:
    """Peers ask in any order, segments have any length; nothing is refused on both sides until the run is over."""
    assert limiter.total is not None
    inserted = drawn = turn = 0
    while True:
        insert = limiter.why_not_insert(inserted, drawn) is None
        sample = limiter.why_not_sample(inserted, drawn, inserted) is None
        if not (insert or sample):
            break
        if insert and (not sample or order.random() < 0.5):
            inserted += steps[turn % len(steps)]
            turn += 1
        else:
            drawn += 1
        check_kept(limiter, inserted, drawn, max(steps))
    assert inserted >= limiter.total
    assert drawn == limiter.draws_total == floor(limiter.ratio * (limiter.total - limiter.start) + 0.5)
    assert "run complete" in (limiter.why_not_insert(inserted, drawn) or "")
    assert inserted == 0 or "run complete" in (limiter.why_not_sample(inserted, drawn, inserted) or "")


@given(
    limiter=limiters(),
    ratio=st.floats(0.01, 8),
    until=st.integers(0, 300),
    length=st.integers(1, 64),
    order=st.randoms(use_true_random=False),
)
def test_a_changed_ratio_holds_from_there_on(
    limiter: RateLimiter, ratio: float, until: int, length: int, order: Random
) -> None:
    inserted = drawn = 0
    for turn in range(10**6):
        if turn == until:
            limiter = limiter.changed(inserted, drawn, ratio=ratio)
        insert = limiter.why_not_insert(inserted, drawn) is None
        sample = limiter.why_not_sample(inserted, drawn, inserted) is None
        if turn > until:
            check_kept(limiter, inserted, drawn, length)
        if not (insert or sample):
            break
        if insert and (not sample or order.random() < 0.5):
            inserted += length
        else:
            drawn += 1
    assert limiter.total is not None
    assert inserted >= limiter.total
    assert drawn == limiter.draws_total


def test_changed_settings_hold_from_now_on_and_the_others_stay() -> None:
    before = THOUSAND.changed(999, 0, ratio=0.5)
    assert before == replace(THOUSAND, ratio=0.5)  # nothing was drawn yet: the ratio holds from the start on
    assert THOUSAND.changed(1000, 0, ratio=0.5) == replace(THOUSAND, ratio=0.5, origin=(1000, 0))
    everything = THOUSAND.changed(2000, 900, ratio=0.5, tolerance=7.0, total=60_000)
    assert everything == replace(THOUSAND, ratio=0.5, tolerance=7.0, total=60_000, origin=(2000, 900))


@pytest.mark.parametrize("limiter", [THOUSAND, THOUSAND.changed(2000, 900, ratio=0.5)])
def test_a_limiter_comes_back_from_its_table(limiter: RateLimiter) -> None:
    packed = msgpack.unpackb(msgpack.packb(asdict(limiter)))
    assert RateLimiter.from_table(packed) == limiter


def test_a_raised_start_does_not_wedge() -> None:
    limiter = replace(THOUSAND.changed(2000, 1000, ratio=0.5), start=3000)
    for inserted in (2000, 2500, 2999):
        assert limiter.why_not_insert(inserted, 1000) is None
        assert limiter.why_not_sample(inserted, 1000, inserted) == f"waiting for 3,000 transitions, have {inserted:,}"
    assert limiter.why_not_insert(3000, 1000) == "inserts are 1,000 steps ahead of updates"
    assert limiter.why_not_sample(3000, 1000, 3000) is None


def test_a_run_may_start_with_a_full_table() -> None:
    limiter = RateLimiter(ratio=1.0, start=50, tolerance=5, total=50, capacity=50)
    assert limiter.why_not_sample(49, 0, 49) == "waiting for 50 transitions, have 49"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"ratio": 0.0}, "ratio"),
        ({"ratio": float("nan")}, "ratio"),
        ({"ratio": float("inf")}, "ratio"),
        ({"tolerance": -1.0}, "tolerance"),
        ({"tolerance": float("nan")}, "tolerance"),
        ({"start": -1}, "start"),
        ({"start": 101}, "start: 101 transitions, must be at most the total of 100"),
        ({"start": 60, "capacity": 50}, "start: 60 transitions, must be at most the capacity of 50"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, float], words: str) -> None:
    good = RateLimiter(ratio=1.0, start=10, tolerance=5, total=100)
    with pytest.raises(UsageError, match=words):
        replace(good, **settings)  # type: ignore[arg-type]


@given(ratio=st.floats(0.01, 8), start=st.integers(0, 50), steps=st.integers(1, 400))
def test_draws_are_due_when_they_are_admitted_with_tolerance_0(ratio: float, start: int, steps: int) -> None:
    """Lockstep draws what is due, processes what is admitted: as many, up to rounding where two numbers are as near."""
    limiter = RateLimiter(ratio=ratio, start=start, tolerance=0)
    drawn = 0
    for inserted in range(1, start + steps + 1):
        assert limiter.why_not_insert(inserted - 1, drawn) is None
        while limiter.why_not_sample(inserted, drawn, inserted) is None:
            drawn += 1
        exact = ratio * max(0, inserted - start) + 0.5
        assert drawn == limiter.due(inserted) or abs(exact - round(exact)) < 1e-9


def test_a_run_has_as_many_updates_in_lockstep_as_in_processes() -> None:
    config = base_config([])
    config = replace(config, total_steps=30, replay=replace(config.replay, ratio=0.25, learning_starts=7))
    run = Lockstep(config)
    while not run.trainer.outcome():
        for _ in run.play():
            pass
    run.env.close()
    limiter = ReplayCore(config, run.env.spec).limiter
    assert run.agent.updates == limiter.draws_total == config.planned_updates == 6
