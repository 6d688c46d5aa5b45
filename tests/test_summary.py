"""The summary with which a run ends."""

import json
from pathlib import Path

import pytest

from coop.common.errors import RunError
from coop.common.settings.config import RunConfig
from coop.common.settings.environment import EnvSettings
from coop.records.checkpoints import checked_summary
from coop.records.run_directory import RunDirectory
from coop.records.summaries import Summary, read_summary


@pytest.mark.parametrize(
    ("episodes", "returns"),
    [
        (0, "no episode ended"),
        (1, "return of 1 episode 22.6 (20.8)"),
        (100, "return of 100 episodes 22.6 (20.8)"),
        (1234, "return of the last 100 of 1,234 episodes 22.6 (20.8)"),
    ],
)
def test_it_says_how_many_episodes_the_return_is_of(episodes: int, returns: str) -> None:
    summary = Summary("dqn", "CartPole-v0", 0, 1000, 900, episodes, 22.6, 20.8, 3.4, 1000, 0, 0, "complete")
    assert str(summary) == f"complete: 1,000 steps, 900 updates, {returns}, 3 s"


def test_a_run_that_goes_on_has_none(tmp_path: Path) -> None:
    config = RunConfig(env=EnvSettings(id="CartPole-v0"))
    with RunDirectory(tmp_path / "run", config) as directory:
        directory.conclude(
            Summary("dqn", "CartPole-v0", 0, 1000, 900, 10, 22.6, 20.8, 3.4, 1000, 0, 0, "complete"), "a run"
        )
    assert (tmp_path / "run" / "summary.json").exists()
    with RunDirectory(tmp_path / "run", config):
        assert not (tmp_path / "run" / "summary.json").exists()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("records", value) for value in (5, [1], {"a": 1}, {"a": ["x", "y"]}, {"a": [-5, 0]}, {"a": [1]})),
        *(("env_steps", "x"), ("return_mean_100", [1]), ("exit", 1), ("fallbacks", "x"), ("updates", None)),
    ],
)
def test_fields_of_other_types_are_named(field: str, value: object, tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text(json.dumps({"exit": "complete", field: value}))
    for read in (read_summary, checked_summary):
        with pytest.raises(RunError, match=rf"summary\.json: can't be read: .*\$\.{field}"):
            read(tmp_path)
