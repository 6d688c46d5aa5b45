"""The numbers on pages of results, docs and the README are those of the studies: results/claims.toml ties them."""

import hashlib
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from samples import PINNED

from benchmarks import feedback
from coop.evaluation.film import Film
from coop.evaluation.saved import SavedRun
from coop.studies.report import comparisons
from coop.studies.report import results as tables
from coop.studies.report.baseline import baseline_table, find_baseline
from coop.studies.report.intervals import over_seeds
from coop.studies.report.measures import shorter_runs
from coop.studies.report.sources import open_source
from coop.studies.report.study import Study, load_study
from results import controls
from results.cartpole.edl import verdict
from results.cartpole.hold import verdict as hold
from results.minatar import registered
from results.minatar.edl import verdict as minatar_edl
from results.minatar.edl.play import rows_of
from results.pong import steps

RESULTS = Path(__file__).parent.parent / "results"
CLAIMS = tomllib.loads((RESULTS / "claims.toml").read_text())["claim"]
PAGES = {
    page: " ".join((RESULTS / page).read_text().split())
    for page in (
        "README.md",
        "cartpole/README.md",
        "cartpole/edl/README.md",
        "cartpole/hold/README.md",
        "minatar/README.md",
        "minatar/plan.md",
        "minatar/edl/README.md",
        "pong/README.md",
        "../README.md",
        "../docs/cartpole.md",
        "../docs/algorithm.md",
    )
}
PROGRAMS = {
    "edl": lambda: verdict.tables(verdict.load(RESULTS / "cartpole" / "edl" / "dissection.parquet")),
    "hold": lambda: hold.tables(hold.load(RESULTS / "cartpole" / "hold" / "hold.parquet")),
    "pong-steps": lambda: {"steps": pd.read_csv(RESULTS / "pong" / "steps.csv")},
    "minatar-edl": lambda: minatar_edl.tables(rows_of(None, RESULTS / "minatar" / "edl" / "edl.parquet")),
}
TABLES = {
    "table1": tables.paper_table,
    "settings": tables.settings_table,
    "aggregate": tables.aggregate_table,
    "improvement": tables.improvement_table,
    "breaking_points": tables.breaking_table,
    "runs": tables.runs_table,
    "learning": comparisons.learning_table,
    "paired": comparisons.paired_table,
    "sizes": comparisons.sizes_table,
    "interaction": comparisons.interaction_table,
    "common_breaking": comparisons.common_breaking_table,
}


@cache
def study_of(name: str) -> Study:
    return load_study(RESULTS / (f"{name}.parquet" if "/" in name else f"cartpole/{name}.parquet"))


@cache
def of_program(study: str) -> dict[str, pd.DataFrame]:
    """The tables of a study with a program of its own."""
    return PROGRAMS[study]()


@cache
def table_of(study: str, name: str) -> pd.DataFrame:
    if study in PROGRAMS:
        return of_program(study)[name]
    if name in controls.TABLES:
        return controls.TABLES[name](study_of(study))
    if name in registered.RULES:
        return registered.table_of(name, study_of(study))
    kind, _, baseline = name.partition(" ")
    if kind == "baseline":
        table = baseline_table(study_of(study), find_baseline(study_of(study), baseline))
    else:
        table = TABLES[name](study_of(study))
    return pd.DataFrame(table.rows, columns=list(table.columns))


def cells_of(claim: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, cell in claim["cells"].items():
        (row,) = table_of(claim["study"], cell["table"]).query(claim["where"]).query(cell["where"]).to_dict("records")
        yield name, row


def texts(claim: dict[str, Any]) -> Iterator[str]:
    """The claim's texts with the numbers filled in."""
    if "cells" in claim:
        yield claim["text"].format_map(dict(cells_of(claim)))
        return
    rows = table_of(claim["study"], claim["table"])
    if "where" in claim:
        rows = rows.query(claim["where"])
    for column in claim.get("percent", []):
        rows = rows.assign(**{column: 100 * rows[column]})
    by, key = claim.get("by", []), claim.get("key", [])
    by, key = ([each] if isinstance(each, str) else each for each in (by, key))
    if claim.get("average"):
        groups = rows.groupby([*by, *key], sort=False)
        spread = groups.std(numeric_only=True).add_suffix(" sd")
        rows = pd.concat([groups.mean(numeric_only=True), spread, groups.size().rename("count")], axis=1).reset_index()
    for at, group in rows.groupby(by, sort=False) if by else [((), rows)]:
        names = {"at": at[0] if len(at) == 1 else at}
        for row in group.to_dict("records"):
            name = re.sub("[.:]", "_", " ".join(str(row[each]) for each in key)) or "row"
            assert name not in names, f"two rows are called {name}"
            names[f"n{name}" if name[:1].isdigit() else name] = row
        templates = [claim["text"]] if isinstance(claim["text"], str) else claim["text"]
        yield from (template.format_map(names) for template in templates)


@pytest.mark.parametrize("study", sorted({claim["study"] for claim in CLAIMS}))
def test_the_page_says_what_the_data_say(study: str) -> None:
    wrong = [
        text
        for claim in CLAIMS
        if claim["study"] == study
        for text in texts(claim)
        if re.sub(r"\s+", " ", text) not in PAGES[claim.get("page", "cartpole/README.md")]
    ]
    assert not wrong


def test_a_number_that_is_not_in_the_page_is_found() -> None:
    claim = {
        "study": "agree-lockstep",
        "table": "runs",
        "where": "seed == 0",
        "text": "a return of {row[mean]:.3f} here",
    }
    (text,) = texts(claim)
    assert re.fullmatch(r"a return of \d+\.\d{3} here", text)
    assert text not in PAGES["README.md"]


def test_what_the_pages_say_of_runs_without_a_buffer() -> None:
    small = "method in ('dqn', 'edql', 'g-coop', 'coop') and `replay.capacity` == 300"
    runs = table_of("minatar/study", "runs")
    breakout = runs[runs["env.id"] == "MinAtar/Breakout-v1"]
    assert breakout.query(small)["mean"].max() < breakout.query("method == 'stream-q'")["mean"].min()
    areas = registered.areas(study_of("minatar/study")).rename(columns={"capacity": "replay.capacity"})
    invaders = areas[areas["game"] == "SpaceInvaders"]
    assert invaders.query(small)["area"].min() > invaders.query("method == 'stream-q'")["area"].max()


def test_what_the_page_says_of_low_ends_in_longer_runs() -> None:
    runs = table_of("preset-buffers", "runs")
    found = [
        f"{(part['mean'] < 180).sum()} of {len(part)}"
        for large in (True, False)
        for names in (("g-coop", "coop"), ("dqn", "edql"))
        for part in [runs[((runs["replay.capacity"] >= 1500) == large) & runs["method"].isin(names)]]
    ]
    text = "or more, {} with two networks ends below 180, and {} with one; with fewer, {} and {}.".format(*found)
    assert text in PAGES["cartpole/README.md"]
    assert runs[runs["method"] == "stream-q"]["mean"].min() >= 199.9


def games_of(run: str, study: str = "pong") -> pd.DataFrame:
    source = open_source(RESULTS / f"{study}.parquet")
    return pd.DataFrame(source.columns(run, "episodes.csv", ("env_step", "return")))


def test_what_the_page_of_pong_says() -> None:
    page = PAGES["pong/README.md"]
    games, falling, half = (games_of(run) for run in ("coop", "coop-falling", "coop-bfloat16"))
    last, late = games["return"][-100:], games["return"][games["env_step"] > 400_000]
    best = games["return"].rolling(100).mean().idxmax()
    first = games["env_step"][games["return"] > 0].iloc[0]
    assert not (falling["return"] > 0).any()
    stopped, third = falling["return"][-100:], half["return"][-100:]
    parts = half["return"].groupby((half["env_step"] - 1) // 50_000).mean()
    for text in (
        f"a return of {stopped.mean():.1f} ({stopped.std(ddof=0):.1f}) over the last 100 games and no game won, "
        f"where the first run had won {(games['return'][games['env_step'] <= 374_834] > 0).sum()}",
        f"a return of {third.mean():.1f} ({third.std(ddof=0):.1f}) over the last 100 games, "
        f"no game won and its best game at {half['return'].max():.0f}",
        f"its mean over 50,000 steps fell from {parts[3]:.1f} to {parts[6]:.1f}",
        f"a return of {last.mean():.1f} ({last.std(ddof=0):.1f}) over the last 100 games, {sum(last > 0)} of them won",
        f"was {games['return'].rolling(100).mean().max():.1f}, at {games['env_step'][best]:,} steps",
        f"Its first win came at {first:,} steps",
        f"{(late >= 18).sum()} of {len(late)} games end at 18 or more and {(late < 10).sum()} below 10",
    ):
        assert text in page
    for _, part in games.groupby((games["env_step"] - 1) // 100_000):
        won = (part["return"] > 0).sum()
        assert f"| {len(part)} | {won} | {part['return'].mean():.1f} |" in page


def test_what_the_page_of_pong_says_of_the_continued_run() -> None:
    page = PAGES["pong/README.md"]
    games, halving = games_of("coop-continued"), games_of("coop-continued-halving")["return"]
    returns, low = games["return"], games[games["return"] < 10]
    summary = SavedRun(RESULTS / "pong" / "coop-continued").summary
    assert summary is not None
    assert (len(games), len(low), summary["exit"]) == (100, 4, "complete: target_return reached")
    assert summary["return_mean_100"] == pytest.approx(returns.mean())
    assert returns.mean() >= 18
    last = returns[low.index[-1] + 1 :]
    for text in (
        f"{returns.mean():.1f} ({returns.std(ddof=0):.1f}), {(returns > 0).sum()} of the 100 games won, "
        f"after {summary['env_steps']:,} more steps, {summary['updates']:,} updates and "
        f"{summary['wall_seconds']:,.0f} s",
        f"Four of them end below 10, the last of these at {low['env_step'].iloc[-1]:,} steps; "
        f"the {len(last)} games after it average {last.mean():.1f}",
        f"stood at {returns[:33].mean():.1f} over its first 33 games, was stopped at 94,224 steps with a mean of "
        f"{halving.mean():.1f} ({halving.std(ddof=0):.1f}) over its {len(halving)} games, "
        f"{(halving > 0).sum()} of them won",
        f"Until the same step the run above has a mean of {returns[games['env_step'] <= 94_224].mean():.1f}",
    ):
        assert text in page
    text = (
        f"one run comes to a mean of {games_of('coop')['return'][-100:].mean():.1f} over 100 games, and a run that "
        f"goes on from its networks with a fifth of the learning rate to {returns.mean():.1f}"
    )
    assert text in PAGES["README.md"]


@pytest.mark.parametrize("study", ["methods", "feedback"])
def test_what_the_page_says_of_methods_on_pong(study: str) -> None:
    page = PAGES["pong/README.md"]
    for run in study_of(f"pong/{study}").runs:
        games = games_of(run.name, f"pong/{study}")
        returns, won = games["return"], games[games["return"] > 0]
        first = f"{won['env_step'].iloc[0]:,}" if len(won) else "none"
        parts = returns.groupby((games["env_step"] - 1) // 100_000).mean()
        last, best = returns[-100:], returns.rolling(100).mean().max()
        assert (
            f"| {run.config.method} | {len(games)} | {len(won)} | {first} | "
            f"{last.mean():.1f} ({last.std(ddof=0):.1f}) | {best:.1f} | {' | '.join(f'{part:.1f}' for part in parts)} |"
        ) in page


def test_what_the_page_says_of_edql_on_pong() -> None:
    games = games_of("edql-seed=0", "pong/methods")
    late = games["return"][games["env_step"] > 400_000]
    assert f"wins {(late > 0).sum()} of its {len(late)} games after 400,000 steps" in PAGES["pong/README.md"]


def test_what_feedback_does_on_pong() -> None:
    on = pd.read_csv(RESULTS / "pong" / "steps.csv").query("feedback == 'transform' and on")
    assert on["layer"].tolist() == [1]  # "makes the first convolution's steps shorter", "on, in one layer"
    turned = steps.measure("weight-gradient", 2210)
    assert list(turned["layer"]) == [1, 2, 3, 4]
    assert (turned["cosine"] < 0.9).all()
    assert turned["on"].all()


def test_the_networks_of_pong_win() -> None:
    run = SavedRun(RESULTS / "pong" / "coop-continued")
    film = Film(run.policy("mean"), run.config.env, seed=0)
    for _ in film:
        pass
    assert film.episode_return > 0


def test_studies_that_share_runs() -> None:
    """The page says that one set of five runs is shown in three studies."""
    shown = {
        "buffers": "method == 'coop' and `replay.capacity` == 5000",
        "exploration": "`edl.rate` == 0.1",
        "choices": "`edl.noise` == 'normal' and `edl.feedback` == 'transform' and not `learner.reset_role_at_episode`",
    }
    returns = []
    for study, where in shown.items():
        names = set(table_of(study, "runs").query(where)["run"])
        chosen = {run.config.seed: run.returns.tolist() for run in study_of(study).runs if run.name in names}
        assert sorted(chosen) == [0, 1, 2, 3, 4]
        returns.append(chosen)
    assert returns[0] == returns[1] == returns[2]


def test_the_differences_of_the_two_feedbacks() -> None:
    """The runs of one are in another file than those of the other."""
    at = ["edl.noise", "learner.reset_role_at_episode", "seed"]
    transform = table_of("choices", "runs").query("`edl.feedback` == 'transform'").set_index(at)["mean"]
    gradient = table_of("choices-again", "runs").set_index(at)["mean"]
    found = [over_seeds(values.to_numpy()) for _, values in (gradient - transform).groupby(level=at[:2])]
    *first, last = (f"{each.value:.1f} [{each.low:.1f}, {each.high:.1f}]" for each in found)
    assert f"minus `transform` is {', '.join(first)} and {last}, line by line" in PAGES["cartpole/README.md"]
    worst = f"ends at {transform.min():.1f} makes most of the first difference, one at {gradient.min():.1f} most of"
    assert worst in PAGES["cartpole/README.md"]


INTERVAL = re.compile(r"\[[+-]?\d[\d.,]*, [+-]?\d[\d.,]*\]")


def test_the_page_counts_its_intervals() -> None:
    pages = ("", "cartpole/", "cartpole/edl/", "cartpole/hold/", "minatar/", "minatar/edl/")
    here, cartpole, edl, two, minatar, second = (len(INTERVAL.findall(PAGES[f"{at}README.md"])) for at in pages)
    text = (
        f"This page has {here} intervals, that of CartPole {cartpole}, that of EDL {edl}, that of two networks on "
        f"CartPole {two}, those of MinAtar {minatar} and {second};"
    )
    assert text in PAGES["README.md"]


@pytest.mark.parametrize("study", ["minatar", "cartpole/edl"])
def test_what_was_registered_is_as_it_was(study: str) -> None:
    lines = [line.split() for line in (RESULTS / study / "SHA256SUMS").read_text().splitlines()]
    assert lines
    for digest, name in lines:
        assert hashlib.sha256((RESULTS / study / name).read_bytes()).hexdigest() == digest, name


def test_what_the_pages_say_of_short_runs() -> None:
    short = {name: shorter_runs(study_of(name)) for name in ("authors", "authors-buffers")}
    runs = {name: len(study_of(name).runs) for name in short}
    assert f"in {short['authors']} of {runs['authors']} runs all of them" in PAGES["cartpole/README.md"]
    counted = (short["authors-buffers"], runs["authors-buffers"])
    assert "{} of the {} runs have fewer than 100".format(*counted) in PAGES["cartpole/README.md"]
    assert "(of {} of the {} runs: of all episodes".format(*counted) in PAGES["README.md"]


def test_what_the_pages_say_of_s() -> None:
    """How much EDL was on: s when a run begins and ends, its feedback, and whether targets are double."""
    ends = {}
    for name in ("minatar/study", "preset-buffers", "authors-buffers"):
        run = next(run for run in study_of(name).runs if run.config.method == "coop")
        edl = run.config.edl
        ends[name] = (
            edl.rate,
            edl.noise,
            edl.feedback,
            edl.rate * edl.decay ** (run.config.total_steps / edl.decay_every),
        )
        assert run.config.learner.double == (name != "minatar/study")
    assert ends["minatar/study"] == (0.01, "normal", "transform", pytest.approx(0.002, abs=1e-4))
    assert ends["preset-buffers"] == (0.1, "normal", "transform", pytest.approx(0.1 * 0.9**50))
    assert ends["authors-buffers"] == (0.1, "constant", "weight-gradient", pytest.approx(0.0904, abs=1e-4))
    assert "s is 0.01 N(0, 1) and falls by 0.9 every 10,000 updates, to 0.002 at the end" in PAGES["minatar/README.md"]
    for page in ("README.md", "../README.md"):
        assert "s = 0.01 N(0, 1)" in PAGES[page]
        assert "falling to 0.002" in PAGES[page]


@pytest.mark.timeout(300)  # 13 s of processor time, on a busy machine
def test_what_feedback_does_to_a_step() -> None:
    """The table of docs/algorithm.md, and what the pages quote of it.

    Another PyTorch than the pinned one completes weights' gradients of deficient rank otherwise, by rounding.
    """
    rows = feedback.measure(1000)
    page = (RESULTS / "../docs/algorithm.md").read_text()
    columns = ("gradient", "cosine", "step", "step_cosine")
    for (case, when), part in rows.groupby(["case", "when"], sort=False):
        if PINNED or not case.startswith("weight-gradient"):
            (line,) = (line for line in page.splitlines() if line.startswith(f"| {case} | {when} |"))
            printed = [float(number) for number in re.findall(r"\d+\.\d\d", line.split(" | ", 2)[2])]
            assert printed == pytest.approx([value for what in columns for value in part[what]], abs=0.012)
    later = rows[rows["when"] == "later"].set_index("case")
    plain = [f"{value:.2f}" for value in later.loc["transform, constant s", "gradient"]]
    turned = [f"{value:.2f}" for value in later.loc["weight-gradient, constant s", "step_cosine"]]
    assert f"{plain[0]}, {plain[1]}, {plain[2]} and {plain[3]} times as long by layer" in PAGES["README.md"]
    assert f"cosine {turned[1]} and {turned[2]}" in PAGES["README.md"]
