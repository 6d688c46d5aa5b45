"""The second MinAtar study: cells, the order of its phases, and rules are the plan's."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import ttest_1samp

from coop.common.errors import UsageError
from coop.common.process.lifecycle import Stop
from coop.common.settings.config import RunConfig
from coop.learner.agent import Agent
from coop.lockstep.lockstep import Lockstep
from coop.lockstep.run import LockstepRun
from coop.records.reading import read_csv
from coop.records.resumption import Start
from coop.studies.report.learning import area
from coop.studies.report.study import load_study
from results.minatar.edl import play, rules, verdict
from results.minatar.edl.plain_steps import PlainSteps

VARIANTS = ("dqn", "edql", "g-coop", "coop", "g-coop-2", "coop-2")
ON, OFF = 0.5, 0.99  # cosines


def config_of(method: str, **edl: Any) -> RunConfig:
    cells = play.EdlGrid().rates("transform", double=False)
    found = next(cell.config for cell in cells if cell.variant == method and cell.capacity == 300)
    return replace(found, total_steps=400, edl=replace(found.edl, **edl))


def trained(config: RunConfig, every: int = 0) -> tuple[Agent, PlainSteps | None]:
    """The agent of a run that is over, and what was measured beside it."""
    run = Lockstep(config)
    assert isinstance(run.agent, Agent)
    steps = PlainSteps(run.agent, every) if every else None
    while not run.trainer.outcome():
        for _ in run.play():
            pass
    run.env.close()
    return run.agent, steps


def multiple(p: list[float]) -> list[float]:
    """Holm's adjustment, as its paper writes it."""
    order = sorted(range(len(p)), key=lambda place: p[place])
    found, least = [0.0] * len(p), 0.0
    for rank, place in enumerate(order):
        least = max(least, min(1.0, (len(p) - rank) * p[place]))
        found[place] = least
    return found


def test_the_grid_is_the_plans() -> None:
    grid = play.EdlGrid()
    rates = dict.fromkeys(product(VARIANTS, (300, 100000)), 0.001)
    cells = {
        "pilot": grid.pilot("transform"), "double": grid.double("weight-gradient"),
        "rates": grid.rates("weight-gradient", double=True), "study": grid.study("weight-gradient", True, rates),
    }  # fmt: skip
    runs = {phase: sum(len(cell.seeds) for cell in found) for phase, found in cells.items()}
    assert runs == {
        "pilot": 2 * 2 * 2 * 2,
        "double": 2 * 2 * 2 * 2 * 2,
        "rates": 6 * 2 * 2 * 3 * 2,
        "study": 6 * 2 * 2 * 10,
    }
    seeds = {phase: {seed for cell in found for seed in cell.seeds} for phase, found in cells.items()}
    assert sum(map(len, seeds.values())) == len(set().union(*seeds.values())), "no seed serves two phases"
    assert seeds["study"] == set(range(400, 410))
    for phase, found in cells.items():
        assert len({cell.name for cell in found}) == len(found)
        for cell in found:
            config = cell.config
            assert config.total_steps == (60_000 if phase == "study" else 30_000)
            assert (config.replay.capacity, config.replay.learning_starts) == (cell.capacity, 300)
            assert (config.learner.double, config.learner.learning_rate) == (cell.double, cell.rate)
            assert config.env.id == f"MinAtar/{cell.game}-v1"
            assert config.method == cell.variant.removesuffix("-2")
            twice = cell.variant.endswith("-2")
            assert (config.replay.ratio, config.swap_period) == ((2, 2000) if twice else (1, 1000))
            if config.method in ("edql", "coop"):
                edl = config.edl
                assert (edl.rate, edl.decay, edl.noise, config.feedback) == (0.1, 1, "constant", cell.feedback)
            else:
                assert (cell.feedback, config.feedback) == ("none", "none")


@pytest.mark.parametrize(
    ("method", "feedback"), [("edql", "transform"), ("coop", "transform"), ("coop", "weight-gradient")]
)
def test_plain_steps_leave_the_run_as_it_is(method: str, feedback: str) -> None:
    config = config_of(method, feedback=feedback)
    config = replace(config, learner=replace(config.learner, swap_every=40))
    one, _ = trained(config)
    other, steps = trained(config, 10)
    for first, second in zip(one.networks, other.networks, strict=True):
        assert first.flat.equal(second.flat)
    assert steps is not None
    assert [row["update"] for row in steps.rows][:3] == [10, 20, 30]
    assert len(steps.rows) == 10
    for row in steps.rows:
        assert len(row["cosine"]) == len(row["ratio"]) == 3, "a layer each"


def test_plain_steps_are_those_of_plain_gradients() -> None:
    _, steps = trained(config_of("edql", rate=0.0), 10)
    assert steps is not None
    for row in steps.rows:
        assert row["cosine"] == pytest.approx([1, 1, 1], abs=1e-6)
        assert row["ratio"] == pytest.approx([1, 1, 1], abs=1e-6)
    config = config_of("edql", rate=3.0, feedback="weight-gradient")
    config = replace(config, total_steps=301, replay=replace(config.replay, learning_starts=300))
    ends = []
    for method in ("edql", "dqn"):  # an update each of the same networks with the same batch
        start = Lockstep(replace(config, method=method)).agent
        end, steps = trained(replace(config, method=method), 1)
        assert (end.updates, start.updates) == (1, 0)
        ends.append((end.networks[0].flat - start.networks[0].flat, steps))
    (driven, steps), (plain, _) = ends
    assert steps is not None
    (row,) = steps.rows
    size = driven.numel() - 128 * 3 - 3  # of all but the last layer
    last = (driven[size:].double(), plain[size:].double())
    assert row["cosine"][-1] == pytest.approx(float(last[0] @ last[1] / (last[0].norm() * last[1].norm())), abs=1e-3)
    assert row["ratio"][-1] == pytest.approx(float(last[0].norm() / last[1].norm()), abs=1e-3)
    assert row["cosine"][-1] < 0.9


def rows_of(cells: list[play.EdlCell], value: Any = None, cosine: float = ON) -> list[dict[str, Any]]:
    """A row of each run of these cells; value: the area of a cell and seed."""
    measures = [
        {"update": 500 * k, "cosine": [1.0, cosine if k > 5 else 0.0, 1.0], "ratio": [1.0] * 3} for k in range(1, 11)
    ]
    return [
        {
            "cell": cell.name, "phase": cell.phase, "game": cell.game, "capacity": cell.capacity,
            "variant": cell.variant, "feedback": cell.feedback, "double": cell.double, "rate": cell.rate, "seed": seed,
            "finite": True, "area": 1.0 if value is None else value(cell, seed),
            "measures": measures if cell.phase == "pilot" else None,
        }
        for cell in cells
        for seed in cell.seeds
    ]  # fmt: skip


def test_each_phase_follows_from_the_one_before() -> None:
    grid = play.EdlGrid()
    rows: list[dict[str, Any]] = []

    def next_cells() -> list[play.EdlCell]:
        return play.due(grid, pd.DataFrame(rows))

    assert next_cells() == grid.pilot("transform")
    rows += rows_of(grid.pilot("transform")[:3], cosine=OFF)
    assert next_cells() == grid.pilot("transform")[3:]
    rows += rows_of(grid.pilot("transform")[3:], cosine=OFF)
    assert next_cells() == grid.pilot("weight-gradient")
    both_off = [*rows, *rows_of(grid.pilot("weight-gradient"), cosine=OFF)]
    with pytest.raises(UsageError, match="no feedback is on"):
        play.due(grid, pd.DataFrame(both_off))
    rows += rows_of(grid.pilot("weight-gradient"))
    assert next_cells() == grid.double("weight-gradient")
    rows += rows_of(next_cells(), lambda cell, seed: 1.1 if cell.double else 1.0)
    assert next_cells() == grid.rates("weight-gradient", double=True)

    def best(cell: play.EdlCell, seed: int) -> float:
        wanted = 2.5e-4 if cell.capacity == 300 else 5e-4
        return 2.0 - abs(np.log2(cell.rate / wanted)) / 4

    rows += rows_of(next_cells(), best)
    chosen = {(name, size): 2.5e-4 if size == 300 else 5e-4 for name, size in product(VARIANTS, (300, 100_000))}
    assert next_cells() == grid.study("weight-gradient", True, chosen)
    rows += rows_of(next_cells())
    assert next_cells() == []
    on = [*rows_of(grid.pilot("transform"))]
    assert play.due(grid, pd.DataFrame(on)) == grid.double("transform"), "the one that is on first is enough"


def test_single_targets_and_small_rates_win_a_tie() -> None:
    grid = play.EdlGrid()
    rows = rows_of(grid.double("transform"), lambda cell, seed: 1.009 if cell.double else 1.0)
    assert rules.targets(pd.DataFrame(rows)).set_index("double")["chosen"].to_dict() == {False: True, True: False}
    near = {2.5e-4: 0.95, 5e-4: 0.995, 1e-3: 1.0}
    rows = rows_of(grid.rates("transform", double=False), lambda cell, seed: near[cell.rate])
    table = rules.rates(pd.DataFrame(rows))
    assert set(table.loc[table["chosen"], "rate"]) == {5e-4}
    assert table["chosen"].sum() == 12


def test_decisions_are_where_the_interval_lies() -> None:
    rng = np.random.default_rng(0)
    for centre, spread in product((-20.0, -7.0, 0.0, 3.0, 7.0, 20.0), (1.0, 3.0, 10.0)):
        values = centre + spread * rng.standard_normal(10)
        found = verdict.decide(values)
        inside = {
            verdict.FOR: found.low > 5, verdict.AGAINST: found.high < -5,
            verdict.EQUIVALENT: found.low > -5 and found.high < 5,
        }  # fmt: skip
        assert (found.p < 0.05) == any(inside.values())
        if found.p < 0.05:
            assert inside[found.nearest]
    values = 8 + rng.standard_normal(10)
    assert verdict.decide(values).p == pytest.approx(ttest_1samp(values, 5).pvalue)


@pytest.mark.parametrize(
    ("better", "answer"),
    [
        ({"coop": 20, "coop-2": 20}, "both together"),
        ({"coop": 20, "coop-2": 20, "g-coop": 20, "g-coop-2": 20}, "two networks"),
        ({"coop": 20, "coop-2": 20, "edql": 20}, "error-driven learning"),
        ({"coop": 20, "coop-2": 20, "g-coop": 20, "g-coop-2": 20, "edql": -20}, "two networks"),
        ({}, "none"),
        ({"coop": -30, "coop-2": -30, "g-coop": -30, "g-coop-2": -30}, "none"),
        ({"g-coop": 20, "coop": 20}, "undecided"),
    ],
)
def test_the_answer_follows_from_the_pooled_rules(better: dict[str, float], answer: str) -> None:
    grid, rng = play.EdlGrid(), np.random.default_rng(1)
    chosen = dict.fromkeys(product(VARIANTS, (300, 100000)), 0.0005)

    def area_of(cell: play.EdlCell, seed: int) -> float:
        level = 10.0 if cell.game == "Breakout" else 40.0
        lost = 0.0 if cell.capacity == 100_000 else -30 + better.get(cell.variant, 0)
        return level * (1 + (lost + rng.normal()) / 100)

    rows = pd.DataFrame(rows_of(grid.study("weight-gradient", False, chosen), area_of))
    table = verdict.pooled(rows)
    assert set(table["seeds"]) == {10}
    assert verdict.answer(table) == answer
    for name, (one, other) in verdict.PAIRS.items():
        expected = better.get(one, 0) - better.get(other, 0)
        found = table.set_index("pair").loc[name]
        assert found["points"] == pytest.approx(expected, abs=2)
    games = verdict.by_game(rows)
    means = verdict.differences(rows).groupby(["pair", "seed"])["points"].mean()
    alone = [verdict.decide(means[name].to_numpy()).p for name in verdict.PAIRS]
    assert list(table["p"]) == pytest.approx(list(multiple(alone)))
    assert len(games) == 12
    large = verdict.areas(rows).set_index(["game", "capacity", "variant"])
    assert large.loc[("SpaceInvaders", 100_000, "dqn"), "mean"] == pytest.approx(40, rel=0.02)
    drawn = verdict.forest(rows).points().frame
    points = drawn.dropna().groupby(["panel", "line"])
    both = [points.get_group(("mean of both games", name))["y"].item() for name in verdict.PAIRS]
    assert both == pytest.approx(list(table["points"]))
    dots = drawn[drawn["low"].isna()].groupby(["panel", "line"])
    assert list(dots.get_group(("SpaceInvaders", "H3, one network"))["x"]) == [4.0] * 10
    first = games.set_index(["pair", "game"]).loc[("H1, equal updates in all", "Breakout")]
    (bar,) = points.get_group(("Breakout", "H1, equal updates in all")).to_dict("records")
    assert (bar["y"], bar["low"], bar["high"]) == pytest.approx((first["points"], first["low"], first["high"]))


def test_areas_are_those_of_reports(tmp_path: Path) -> None:
    cell, folder = play.EdlGrid().double("transform")[0], tmp_path / "run"
    config = replace(cell.config, total_steps=400)
    run = LockstepRun(config, folder, play.PROGRAM, Start())
    run.play(Stop())
    run.close()
    row = play.kept(replace(cell, config=config), 0, folder)
    (found,) = load_study(tmp_path).runs
    assert row["finite"]
    assert row["area"] == pytest.approx(area(found))
    assert row["last"] == pytest.approx(found.returns[-100:].mean())


def test_the_area_of_a_run_that_diverged_is_held(tmp_path: Path) -> None:
    cell, folder = play.EdlGrid().rates("transform", double=False)[0], tmp_path / "run"
    learner = replace(cell.config.learner, learning_rate=1e30)
    config = replace(cell.config, total_steps=2000, learner=learner)
    run = LockstepRun(config, folder, play.PROGRAM, Start())
    summary = run.play(Stop())
    run.close()
    assert summary.exit.startswith("diverged")
    row = play.kept(replace(cell, config=config), 0, folder)
    assert not row["finite"]
    episodes = read_csv(folder / "episodes.csv")
    ends, returns = ([float(episode[name]) for episode in episodes] for name in ("env_step", "return"))
    assert len(returns) < 100
    means = [returns[0], *(np.mean(returns[: k + 1]) for k in range(len(returns)))]
    lengths = np.diff([0, *ends, 2000])
    assert row["area"] == pytest.approx(np.average(means, weights=lengths))
    assert row["curve"][-1] == pytest.approx(means[-1], rel=1e-3)


@pytest.mark.timeout(300)
def test_phases_are_played_packed_and_go_on(tmp_path: Path) -> None:
    text = play.GRID.read_text().replace('"Breakout", "SpaceInvaders"', '"Breakout"').replace("[300, 100_000]", "[300]")
    text = text.replace('["edql", "coop"]', '["edql"]').replace("[300, 301]", "[300, 300]")
    (tmp_path / "grid.toml").write_text(text)
    grid, out, packed = play.EdlGrid(tmp_path / "grid.toml"), tmp_path / "runs", tmp_path / "packed.parquet"
    (cell,) = play.due(grid, play.rows_of(out, packed))
    stop = Stop()

    class UntilTheNextPhase(play.EdlGrid):
        def double(self, feedback: str) -> list[play.EdlCell]:
            stop.set("stopped")
            return super().double(feedback)

    small = UntilTheNextPhase(tmp_path / "grid.toml")
    play.play(small, out, stop, packed, steps=850)
    rows = play.rows_of(out, packed)
    assert list(rows["feedback"]) == ["transform", "weight-gradient"]
    assert [measure["update"] for measure in rows["measures"][0]] == [500]
    assert cell.name == rows["cell"][0]
    assert rules.feedbacks_on(rows) == ["weight-gradient"]
    assert play.pack(out, packed) == 2
    for file in out.glob("*.json"):
        file.unlink()
    again = play.rows_of(out, packed)
    assert list(again["area"]) == pytest.approx(list(rows["area"]))
    assert [cell.phase for cell in play.due(grid, again)] == ["double"] * 2
