"""The study of two networks on CartPole: its cells are the plan's, and its rules say what the plan says."""

import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from coop.common.process.lifecycle import Stop
from coop.studies.report.plots import draw
from results.cartpole.hold import play, verdict
from results.cells import claimed, play_cell, sealed

SEEDS = range(500, 530)


def test_the_grid_is_the_plans() -> None:
    grid = play.read_grid()
    assert grid.seeds == tuple(SEEDS)
    cells = {(cell.variant, cell.eviction, cell.capacity, cell.double): cell for cell in grid.cells}
    sizes, methods = (50, 100, 300, 1000, 2000, 5000), ("dqn", "edql", "g-coop", "coop")
    first = set(product(methods, ("fifo", "reservoir"), sizes, (True,)))
    second = set(product(("g-coop", *verdict.OTHERS), ("fifo", "reservoir"), (300, 5000), (True, False)))
    assert len(grid.cells) == len(cells) == 88
    assert set(cells) == first | second
    for (variant, eviction, capacity, double), cell in cells.items():
        config = cell.config
        assert (config.replay.eviction, config.replay.capacity, config.learner.double) == (eviction, capacity, double)
        assert (config.total_steps, config.replay.learning_starts, config.learner.gamma) == (50_000, 50, 0.95)
        assert config.replay.ratio == (0.5 if variant == "half" else 1)
        assert config.swap_period == {"half": 50, "slow": 200}.get(variant, 100)
        assert config.method == {"one-actor": "g-coop"}.get(variant, variant if variant in methods else "dqn")
        assert cell.player == {"copy-acts": 1, "one-actor": 0}.get(variant)
    assert sum(cell.kept for cell in grid.cells) == 32 + 16
    begun = [cell.name for cell in grid.cells[:12]]
    assert all("-reservoir-" in name and name.endswith("-double") for name in begun)


def runs_of(well: dict[str, float]) -> pd.DataFrame:
    """Runs of part 2 of which the share `well` of a variant's seeds ends well in every setting."""
    rows = [
        {"variant": name, "eviction": eviction, "capacity": capacity, "double": double, "seed": seed,
         "well": (seed * 7 + capacity) % 30 < 30 * share}
        for name, share in well.items()
        for eviction, capacity, double in verdict.SETTINGS
        for seed in SEEDS
    ]  # fmt: skip
    return pd.DataFrame(rows)


BAD, GOOD = 0.5, 1.0


def test_the_packed_cells_are_of_this_plan_and_grid(tmp_path: Path) -> None:
    rows = play.packed_rows()
    assert rows
    assert all(len(found) == len(SEEDS) for found in rows.values())
    other, text = tmp_path / "grid.toml", play.GRID.read_text()
    other.write_text(f"# said in other words\n{text}")
    assert sealed(play.PLAN, other) == sealed(play.PLAN, play.GRID)
    other.write_text(text.replace("529]", "528]"))
    assert sealed(play.PLAN, other) != sealed(play.PLAN, play.GRID)


@pytest.mark.parametrize(
    ("good", "answer"),
    [
        ((), ["it takes two networks"]),
        (("one-actor",), ["it takes two networks"]),
        (("copy-acts",), [verdict.SAYS["copy-acts"], "it is who acts"]),
        (("copy-acts", "one-actor", "half"), [verdict.SAYS["copy-acts"], verdict.SAYS["half"]]),
        (("slow", "one-actor"), [verdict.SAYS["slow"]]),
    ],
)
def test_the_answer_names_what_is_as_good_as_two_networks(good: tuple[str, ...], answer: list[str]) -> None:
    shares = {name: GOOD if name in good else BAD for name in verdict.OTHERS} | {"g-coop": GOOD}
    table = verdict.parts(runs_of(shares))
    assert table is not None
    assert verdict.answer(table) == answer
    outcomes = dict(zip(table["g-coop minus"], table["outcome"], strict=True))
    assert {name for name, outcome in outcomes.items() if outcome == "as good"} == set(good)
    assert set(outcomes.values()) <= {"as good", "g-coop ends well more often"}


def test_a_rule_whose_cells_are_not_complete_says_nothing() -> None:
    runs = runs_of({"g-coop": GOOD, "dqn": BAD})
    assert verdict.parts(runs) is None
    assert verdict.evictions(runs) is None


def test_evictions_count_sizes_that_end_well_by_seed_and_pair() -> None:
    shares = {("g-coop", "fifo"): 0.5, ("dqn", "fifo"): 0.5, ("g-coop", "reservoir"): 1.0, ("dqn", "reservoir"): 0.2}
    shares |= {("coop", eviction): 0.5 for eviction in verdict.EVICTIONS}
    shares |= {("edql", eviction): 0.5 for eviction in verdict.EVICTIONS}
    rng = np.random.default_rng(0)
    rows = [
        {"variant": name, "eviction": eviction, "capacity": size, "double": True, "seed": seed,
         "well": bool(rng.random() < share)}
        for (name, eviction), share in shares.items()
        for size, seed in product(verdict.SIZES, SEEDS)
    ]  # fmt: skip
    runs = pd.DataFrame(rows)
    table = verdict.evictions(runs)
    assert table is not None
    found = table.set_index("rule")
    assert found["outcome"].to_dict()["reservoir"] == "two networks hold"
    assert found["outcome"].to_dict()["fifo"] == "not shown"
    wells = runs.groupby(["variant", "eviction"])["well"].sum() / len(SEEDS)
    mean = (wells["g-coop", "reservoir"] - wells["dqn", "reservoir"] + wells["coop", "reservoir"] - wells["edql", "reservoir"]) / 2  # fmt: skip  # noqa: E501
    assert found["mean"]["reservoir"] == pytest.approx(mean)
    assert found["mean"]["fifo - reservoir"] == pytest.approx(found["mean"]["fifo"] - found["mean"]["reservoir"])


def test_beside_the_rules_stand_sizes_and_error_driven_learning() -> None:
    at = {100: 0.2, 300: 0.4, 1000: 0.6, 5000: 0.9}
    better = {"dqn": 0.0, "g-coop": 0.5, "edql": 0.1, "coop": 0.3}  # times the above, in share of the seeds
    rows = [
        {"variant": name, "eviction": eviction, "capacity": size, "double": True, "seed": seed,
         "well": (seed - 500) < 30 * round(at[size] * share, 10)}
        for name, share in better.items()
        for eviction, size, seed in product(verdict.EVICTIONS, verdict.SIZES, SEEDS)
    ]  # fmt: skip
    runs = pd.DataFrame(rows)
    table = verdict.beside(runs).set_index(["eviction", "of"])
    shares = runs.groupby(["eviction", "variant", "capacity"])["well"].mean().unstack("variant")
    two = (shares["g-coop"] - shares["dqn"] + shares["coop"] - shares["edql"]) / 2
    edl = (shares["edql"] - shares["dqn"] + shares["coop"] - shares["g-coop"]) / 2
    for eviction in verdict.EVICTIONS:
        found, lead = table.loc[eviction]["mean"], two[eviction]
        assert [found[f"{size:,}"] for size in verdict.SIZES] == pytest.approx([lead[size] for size in verdict.SIZES])
        assert found["small - large"] == pytest.approx((lead[100] + lead[300] - lead[1000] - lead[5000]) / 2)
        assert found["EDL"] == pytest.approx(edl[eviction].mean())
    assert (table["low"] < table["mean"]).all()
    assert verdict.beside(runs[runs["variant"] != "edql"]).empty


def test_figures_show_the_share_of_seeds_that_end_well(tmp_path: Path) -> None:
    other = dict.fromkeys(("last", "area", "churn", "q_share"), 0.0) | {"collapsed": False, "finite": True}
    runs = runs_of({"dqn": 0.2, "coop": 0.5, "one-actor": 0.7}).assign(**other)
    first, second = (figure.points().frame.set_index(["panel", "line"]) for figure in verdict.figures(runs))
    assert list(first.loc[("fifo", "coop"), "x"]) == [300, 5000]
    assert list(first.loc[("fifo", "coop"), "y"]) == pytest.approx([0.5, 0.5])
    assert set(first.index) == set(product(verdict.EVICTIONS, ("dqn", "coop")))
    low, high = verdict.exact(21, 30)
    (row,) = second.loc[[("reservoir, 5,000 transitions", "one-actor")]].to_dict("records")
    assert row == {"x": 5.0, "y": pytest.approx(0.7), "low": pytest.approx(low), "high": pytest.approx(high)}
    for figure in verdict.figures(runs):
        draw(figure, tmp_path / f"{figure.name}.png")
    assert "E" not in verdict.tables(runs)


@pytest.mark.parametrize(("hits", "count"), [(0, 30), (1, 30), (17, 30), (30, 30)])
def test_intervals_of_shares_are_exact(hits: int, count: int) -> None:
    interval = binomtest(hits, count).proportion_ci(method="exact")
    assert verdict.exact(hits, count) == pytest.approx(tuple(interval))


def test_mcnemar_counts_the_pairs_that_differ() -> None:
    one, other = [True] * 8 + [False, True, False], [False] * 8 + [True, True, False]
    assert verdict.mcnemar(one, other) == pytest.approx(20 / 512)
    assert verdict.mcnemar([True], [True]) == 1


@pytest.mark.timeout(300)
def test_a_study_goes_on_where_it_stopped_and_is_packed(tmp_path: Path) -> None:
    pytest.importorskip("numba")
    whole = play.read_grid()
    by_name = {cell.name: cell for cell in whole.cells}
    cells = (by_name["copy-acts-reservoir-300-double"], by_name["half-fifo-300-single"])
    grid, stop = play.HoldGrid(cells, (500, 501)), Stop()
    stop.set("stopped")
    configs = {500: replace(cells[0].config, total_steps=450, seed=500)}
    assert not play_cell(cells[0].name, configs, tmp_path, stop, lambda runs, *_: runs[0].play(stop), play.PROGRAM)
    with claimed(tmp_path, cells[0].name) as mine:
        assert mine
        play.play(replace(grid, cells=cells[:1]), tmp_path, Stop(), steps=450)
    assert not list(tmp_path.glob("*.npz")), "another process plays the cell"
    play.play(grid, tmp_path, Stop(), steps=450)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{cell.name}.npz" for cell in cells]
    assert play.pack(grid, tmp_path, tmp_path / "packed.parquet") == 2
    runs = verdict.load(tmp_path / "packed.parquet")
    assert list(runs["seed"]) == [500, 501] * 2
    assert all(400 < sum(returns) <= 450 for returns in runs["returns"])
    assert runs["last"].to_list() == pytest.approx([np.mean(returns) for returns in runs["returns"]])
    assert not runs["well"].any()
    assert runs["finite"].all()
    assert len(verdict.cells(runs)) == 2
    for path in tmp_path.glob("*.npz"):
        path.unlink()
    play.play(grid, tmp_path, Stop(), steps=450, packed=play.packed_rows(tmp_path / "packed.parquet"))
    assert [path.name for path in tmp_path.iterdir()] == ["packed.parquet"], "packed cells are not played again"
    assert play.pack(grid, tmp_path, tmp_path / "packed.parquet") == 2
    assert verdict.load(tmp_path / "packed.parquet").equals(runs)


@pytest.mark.parametrize(
    "module", ["results.cartpole.hold.play", "results.minatar.edl.play", "coop.lockstep.compiled.together"]
)
def test_help_and_wrong_flags_end_as_in_other_commands(module: str) -> None:
    pytest.importorskip("numba")
    for flags, status in ((["--help"], 0), (["--no-such-flag"], 2)):
        done = subprocess.run([sys.executable, "-m", module, *flags], capture_output=True, text=True, check=False)
        assert done.returncode == status
        assert "sys.exit" not in done.stderr
        assert "usage: python -m " in done.stdout + done.stderr
