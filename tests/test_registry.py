"""Methods and policies of other packages: found by entry point, chosen by name, refused in one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from coop.common.errors import UsageError
from coop.common.registry import Registry
from coop.common.settings.methods import METHODS, Method
from coop.studies.report.plots import OTHERS, _colour

MODULE = """
from dataclasses import dataclass

import numpy as np

from coop.common.settings.conditions import Condition
from coop.common.settings.methods import Method
from coop.common.settings.policies import EvictionPolicy, SamplingPolicy
from coop.replay.table.policies import Eviction, Sampling


@dataclass(frozen=True)
class SoftSettings:
    weight: float = 0.5
    other: int = 1


class MostDrawn(Eviction):
    def place(self, first, count):
        size, capacity = min(first, self.table.capacity), self.table.capacity
        kept = min(count, capacity)
        unused = np.arange(size, min(size + kept, capacity))
        worst = np.argsort(-self.table.reuse[:size], kind="stable")[: kept - len(unused)]
        return np.concatenate((unused, worst)), slice(count - kept, count)


class Newest(Sampling):
    def draw(self, count, size):
        return np.argsort(-self.table.ids[:size])[np.arange(count) % size], np.ones(count, np.float32)


def make_newest(table):
    return Newest(table)


SOFT = Method("soft-max", "a mean of both", rule="my_rules:Soft", settings=SoftSettings,
              conditions=(
                  Condition(("soft_max.other",), lambda c: c.method_settings.weight > 0, "soft_max.weight = 0"),))
EVICTION = EvictionPolicy("most-drawn", MostDrawn)
SAMPLER = SamplingPolicy("newest", make_newest)
"""
RULES = """
from coop.learner.methods.rule import UpdateRule


class Soft(UpdateRule):
    def bootstrap(self, next_values, preferred):
        weight = self.config.method_settings.weight
        return weight * next_values.max(1) + (1 - weight) * next_values.mean(1)
"""
ENTRY_POINTS = """
[coop.methods]
soft-max = my_methods:SOFT
broken = my_methods:NOTHING
renamed = my_methods:SOFT
kind = my_methods:EVICTION
[coop.evictions]
most-drawn = my_methods:EVICTION
[coop.samplers]
newest = my_methods:SAMPLER
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder for the module path with an installed package that has a method and two policies."""
    info = tmp_path / "my_methods-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-methods\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (tmp_path / "my_methods.py").write_text(MODULE)
    (tmp_path / "my_rules.py").write_text(RULES)
    return tmp_path


def methods() -> Registry[Method]:
    return Registry(
        "method", "coop.methods", Method, {"dqn": METHODS.get("dqn"), "medqn": "coop.common.settings.medqn:MEDQN"}
    )


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("soft-min", "method = 'soft-min': unknown; did you mean soft-max? allowed: dqn, medqn, broken, kind"),
        ("broken", "method 'broken' = 'my_methods:NOTHING': module 'my_methods' has no 'NOTHING'"),
        ("renamed", "method 'renamed': my_methods:SOFT has another name, 'soft-max'"),
        ("kind", "method 'kind': my_methods:EVICTION is no Method"),
    ],
)
def test_what_is_no_method_is_refused(name: str, words: str, package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(package)
    with pytest.raises(UsageError) as caught:
        methods().get(name)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_installed_method_is_imported_only_when_asked_for(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(package)
    registry = methods()
    assert registry.names()[:2] == ("dqn", "medqn")
    assert "soft-max" in registry.names()
    assert "my_methods" not in sys.modules
    assert registry.get("soft-max").table == "soft_max"


def test_a_name_belongs_to_one(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    registry = methods()
    registry.register(Method("mine", "mine"))
    assert registry.get("mine").summary == "mine"
    with pytest.raises(UsageError, match="method = 'mine': there is one of that name already"):
        registry.register(Method("mine", "another"))
    (package / "my_methods-1.0.dist-info" / "entry_points.txt").write_text("[coop.methods]\ndqn = my_methods:SOFT\n")
    monkeypatch.syspath_prepend(package)
    assert methods().get("dqn") is METHODS.get("dqn"), "no package takes the name of a method of ours"


LOCKSTEP = "import sys; sys.argv[0] = 'coop-lockstep'; from coop.deploy.commands import main; main()"
OPTIONS = "from coop.records.run_options import RunOptions, parse_run; parse_run(RunOptions, 'coop-local', '')"


def test_figures_have_the_methods_colours_and_other_ones_for_the_rest() -> None:
    taken: list[str] = []
    for label in ("s = 0.1", "medqn", "dqn", "no method"):
        taken.append(_colour(label, taken))
    assert taken == [OTHERS[0], METHODS.get("medqn").colour, METHODS.get("dqn").colour, OTHERS[1]]
    assert len({METHODS.get(name).colour for name in METHODS.names()} | {*OTHERS}) == len(METHODS.names()) + len(OTHERS)


def python(package: Path, code: str, *flags: str) -> subprocess.CompletedProcess[str]:
    environment = {"PYTHONPATH": str(package), "OMP_NUM_THREADS": "1", "PATH": ""}
    command = [sys.executable, "-c", code, *flags]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_a_run_with_parts_of_another_package(package: Path, tmp_path: Path) -> None:
    length = ["--total-steps", "200", "--replay.capacity", "60"]
    policies = ["--replay.eviction", "most-drawn", "--replay.sampling", "newest"]
    flags = ["--method", "soft-max", "--soft-max.weight", "0", "--soft-max.other", "3", *policies]
    run = python(package, LOCKSTEP, *flags, *length, "--run-dir", str(tmp_path / "run"))
    assert run.returncode == 0, run.stderr
    assert run.stderr == "warning: --soft-max.other has no effect: soft_max.weight = 0\n"
    text = (tmp_path / "run" / "config.toml").read_text()
    assert "[soft_max]\nweight = 0.0\nother = 3\n" in text
    assert 'eviction = "most-drawn"\nsampling = "newest"\n' in text
    shown = python(package, OPTIONS, "--help-all")
    assert "--soft-max.weight" in shown.stdout
    assert "soft-max: a mean of both" in " ".join(shown.stdout.split())
    assert "most-drawn" in shown.stdout


def test_entry_points_of_the_backport_are_read_alike(package: Path) -> None:
    """Dask imports `importlib_metadata`, which takes the standard library's place in the whole process."""
    if python(package, "import importlib_metadata").returncode:
        pytest.skip("Dask brings it to Python 3.11 alone")
    code = "from coop.common.settings.methods import METHODS; print(METHODS.get('soft-max').summary)"
    run = python(package, f"import importlib_metadata; {code}")
    assert (run.stdout, run.stderr) == ("a mean of both\n", "")


def test_the_replay_service_knows_every_name_without_torch() -> None:
    code = (
        "import sys, coop.replay.cli\n"
        "from coop.common.settings.tables import resolve\n"
        "from coop.common.types import EnvSpec\n"
        "from coop.replay.core import ReplayCore\n"
        "spec = EnvSpec('x', (4,), 'float32', 1, 2)\n"
        "for method in ('dqn', 'edql', 'g-coop', 'coop', 'medqn'):\n"
        "    ReplayCore(resolve({'replay': {'eviction': 'prioritized'}}, method), spec)\n"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
