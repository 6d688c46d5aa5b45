"""What a run needs: the arithmetic, the page that coop-plan prints, and the tables of docs/scaling.md."""

import re
from dataclasses import astuple, replace
from pathlib import Path

import pytest

from common.settings.tables import load_tables, preset_names, resolve
from common.types import EnvSpec
from deploy import plan
from deploy.sizing import COSTS, LINK_BYTES, Sizing, enough_actors, size

ATARI = EnvSpec("breakout", (84, 84), "uint8", 4, 4)
NATURE = 1_686_180  # parameters with four actions
SCALING = Path(__file__).parents[1] / "docs" / "scaling.md"


def breakout(actors: int, method: str = "coop", **changes: float) -> Sizing:
    config = resolve(load_tables("breakout", None), method)
    if "ratio" in changes:
        config = replace(config, replay=replace(config.replay, ratio=changes.pop("ratio")))
    return size(COSTS["breakout"], config, ATARI, NATURE, actors, **changes)


def test_a_slow_learner_limits_many_actors() -> None:
    sizing, costs = breakout(200), COSTS["breakout"]
    assert sizing.bottleneck.name == "learner"
    assert sizing.speed == pytest.approx(1000 / costs.error_driven / 0.25)
    assert enough_actors(sizing) == 1
    assert breakout(200, learner_speedup=2.0).speed == pytest.approx(2 * sizing.speed)
    assert breakout(200, "dqn").speed == pytest.approx(1000 / costs.gradient / 0.25)


def test_each_part_can_be_the_bottleneck() -> None:
    assert breakout(1, ratio=0.001).bottleneck.name == "actors"
    assert breakout(1, ratio=0.001).speed == pytest.approx(1000 / COSTS["breakout"].step)
    assert breakout(10_000, ratio=1e-6, gbits=1000).bottleneck.name == "replay service"
    assert breakout(10_000, learner_speedup=1e6, gbits=0.1).bottleneck.name == "learner's link"
    assert breakout(10_000, ratio=1e-6, gbits=1).bottleneck.name == "replay's link"


def test_weights_that_do_not_fit_are_dropped_and_limit_nothing() -> None:
    few, many = breakout(100), breakout(10_000)
    assert (few.weights_delivered, few.speed) == (1.0, many.speed)
    assert many.weights_delivered == pytest.approx(1.25e9 / (many.speed * many.traffic.weights))


def test_what_a_step_sends() -> None:
    traffic, double = breakout(8).traffic, breakout(16).traffic
    assert traffic.inserts == pytest.approx(7056 + 74, rel=0.02)
    named = 0.25 * (32 * (5 * 16 + 62) + 300)
    assert traffic.draws == pytest.approx(7056 + named), "each frame once, and the names of 160 in each batch"
    assert breakout(8, ratio=0.001).traffic.draws == pytest.approx(0.001 * 32 * 5 * 7056, rel=0.02), "few are drawn"
    assert traffic.weights == pytest.approx(0.25 / 50 * 4 * NATURE * 8)
    assert (double.inserts, double.draws) == (traffic.inserts, traffic.draws)
    assert double.weights == 2 * traffic.weights


def test_memory_grows_by_links() -> None:
    few, many = breakout(10), breakout(1010)
    for place in (1, 2):
        assert many.parts[place].memory - few.parts[place].memory == 1000 * LINK_BYTES
    assert few.parts[1].memory == pytest.approx(1_000_000 * 7_137, rel=0.05)
    assert few.parts[2].memory == pytest.approx(1_000_000 * 7_064, rel=0.1), "the mirror"


def test_the_page(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["coop-plan", "--actors", "200", "--env", "breakout"])
    plan.main()
    text = capsys.readouterr().out
    assert text.startswith("breakout, coop: 200 actors of 8 emulators, 0.25 updates per step\n")
    assert re.search(r"^learner +1 +\d\.\d GiB +\d+ +100%$", text, re.MULTILINE)
    assert re.search(
        r"^bottleneck  learner: a faster learner, .*\n +1 of the 200 actors would keep it busy$", text, re.M
    )
    assert f"speed       {breakout(200).speed:,.0f} steps/s" in text


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--actors", "0"], "--actors 0: must be positive"),
        (["--gbits", "-1"], "--gbits -1.0: must be positive"),
        (["--env", "breakuot"], "'breakuot': unknown; did you mean breakout?"),
        (["--method", "medqn"], "--method medqn: its updates have not been measured; allowed: dqn, edql, g-coop, coop"),
        (["--method", "stream-q"], "--method stream-q: its updates have not been measured"),
        (["--ratio", "0"], "replay.ratio = 0"),
    ],
)
def test_bad_flags(
    flags: list[str], words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["coop-plan", *flags])
    with pytest.raises(SystemExit) as end:
        plan.main()
    assert end.value.code == 2
    assert words in capsys.readouterr().err


def test_the_tables_of_the_documentation_are_the_commands(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = re.findall(
        r"^`(coop-plan [^`]*--table)`.*\n\n((?:\|.*\n)+)", SCALING.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert len(found) == 2
    for command, table in found:
        monkeypatch.setattr("sys.argv", command.split())
        plan.main()
        assert capsys.readouterr().out == table


def test_what_was_measured_is_what_the_documentation_says() -> None:
    rows = re.findall(r"^\| ((?:`[a-z0-9-]+`(?:, )?)+) \|(.*)\|$", SCALING.read_text(encoding="utf-8"), re.MULTILINE)
    told = {
        preset.strip("`"): tuple(map(float, row.split("|"))) for presets, row in rows for preset in presets.split(", ")
    }
    assert told == {preset: astuple(costs) for preset, costs in COSTS.items()}


@pytest.mark.parametrize("preset", preset_names())
def test_every_preset_can_be_planned(
    preset: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if preset.startswith("minatar"):
        pytest.importorskip("minatar")
    monkeypatch.setattr("sys.argv", ["coop-plan", "--actors", "1", "--env", preset])
    plan.main()
    text = capsys.readouterr().out
    costs, ratio = COSTS[preset], resolve(load_tables(preset, None)).replay.ratio
    each = costs.step, costs.insert + ratio * costs.draw, ratio * costs.error_driven
    for part, milliseconds in zip(("actors", "replay service", "learner"), each, strict=True):
        assert re.search(rf"^{part} +1 +[\d.]+ GiB +{1000 / milliseconds:,.0f} ", text, re.MULTILINE)
