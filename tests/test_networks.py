"""Networks of a user's own: built and refused by name, acting, training by every method, saved and taken up again."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import run_command

from coop.actors.policy import EpsilonGreedy
from coop.common.errors import UsageError
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.settings.config import NETWORK_KINDS, NetworkSettings, RunConfig
from coop.common.settings.tables import validated
from coop.common.types import EnvSpec
from coop.evaluation.evaluate import evaluate_checkpoint
from coop.learner.edl.autograd_backprop import AutogradBackprop
from coop.lockstep.lockstep import Lockstep
from coop.records.learner_checkpoints import load_learner
from coop.records.resumption import survey
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config

SPEC = EnvSpec("made-up", (4,), "float32", 1, 3)


def _build(name: str, seed: int = 0) -> torch.nn.Module:
    return build_network(f"custom_networks:{name}", SPEC, (), seed)


@pytest.mark.parametrize(
    "name", ["duel", "residual", "recurrent", "lazy", "doubled", "repeated", "negative", "negatives"]
)
def test_a_network_of_ones_own_is_flat_and_acts(name: str) -> None:
    state = torch.get_rng_state()
    same, other = FlatNetwork(_build(name)), FlatNetwork(_build(name, 1))
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(same.flat, FlatNetwork(_build(name)).flat)
    assert not torch.equal(same.flat, other.flat)
    assert same.layout_digest() == other.layout_digest()
    obs = np.random.default_rng(0).standard_normal((9, 4)).astype(np.float32)
    other.load(same.snapshot())
    actions = EpsilonGreedy((same, other), SPEC, np.random.default_rng(0)).act(obs, 0.0)
    values = _build(name)(torch.from_numpy(obs)).detach()
    np.testing.assert_array_equal(actions, values.argmax(1).numpy())
    torch.testing.assert_close(other(torch.from_numpy(obs)), values)
    if other.in_numpy is not None:
        np.testing.assert_allclose(other.in_numpy(obs), values.numpy(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("missing", "module 'custom_networks' has no 'missing'"),
        ("failing", "RuntimeError: no such game (custom_networks.py:202)"),
        ("leaving", "SystemExit: no such game (custom_networks.py:206)"),
        ("number", "gives int; it must give a torch.nn.Module"),
        ("scalar", "its output is float32 [4, 1] for inputs [4, 4]; it must be float32 [4, 3]"),
        ("normalised", "layer '1' is a BatchNorm1d, in which the samples of a batch meet"),
        ("dropped", "layer '1' is a Dropout; random layers are not supported"),
        ("buffered", "layer '' (Duel) has a buffer, 'mean'; only parameters are trained and saved"),
        ("centred", "its values of one observation depend on the others in the batch"),
        ("frozen", "parameter '0.weight' does not require a gradient"),
        ("mixed", "parameter 'scale' is torch.float64; it must be torch.float32"),
        ("noisy", "its values differ between two calls; random layers are not supported"),
        ("huge", "it has 268,451,855 parameters; allowed: 1 to 66,846,720, what a message carries"),
    ],
)
def test_what_is_no_network_is_refused_in_one_line(name: str, text: str) -> None:
    with pytest.raises(UsageError) as refused:
        _build(name)
    assert str(refused.value) == f"network.kind = 'custom_networks:{name}': {text}"


def test_an_unknown_kind_is_refused_with_those_that_exist() -> None:
    with pytest.raises(UsageError, match=r"network.kind = 'nature3': allowed: mlp, .*minatar, or module:function$"):
        validated(RunConfig(network=NetworkSettings(kind="nature3")))
    with pytest.raises(UsageError, match=f"'nature3' is not one of {', '.join(NETWORK_KINDS)}$"):
        build_network("nature3", EnvSpec("Pictures", (84, 84), "uint8", 4, 4), (), 0)


def _lockstep(method: str, name: str) -> Lockstep:
    flags = ["--preset", "cartpole-paper", "--method", method]  # whose C of 30 the short runs pass
    config = replace(base_config(flags), network=NetworkSettings(f"custom_networks:{name}"))
    return Lockstep(replace(config, replay=replace(config.replay, learning_starts=50), total_steps=300))


def _play(run: Lockstep, directory: RunDirectory, steps: int) -> None:
    for _ in range(steps):
        for effects in run.play():
            directory.record(effects.episodes, effects.metrics)


@pytest.mark.parametrize(
    ("method", "name"),
    [("dqn", "recurrent"), ("edql", "residual"), ("g-coop", "twice"), ("coop", "duel"), ("medqn", "duel")],
)
def test_every_method_trains_it_the_same_way_for_a_seed_and_after_a_resume(
    method: str, name: str, tmp_path: Path
) -> None:
    whole = _lockstep(method, name)
    before = [network.flat.clone() for network in whole.agent.networks]
    with RunDirectory(tmp_path / "whole", whole.config) as directory:
        _play(whole, directory, 90)
    whole.env.close()
    torn = _lockstep(method, name)
    with RunDirectory(tmp_path / "torn", torn.config) as directory:
        _play(torn, directory, 70)
        torn.save(directory)
    torn.env.close()
    resumed = _lockstep(method, name)
    found = survey(tmp_path / "torn", records=True, load=load_learner)
    assert found.newest is not None
    resumed.restore(found.newest)
    with RunDirectory(tmp_path / "torn", resumed.config, found, 20) as directory:
        _play(resumed, directory, 20)
        resumed.save(directory)
    resumed.env.close()
    assert isinstance(whole.agent._networks[0]._trained.backprop, AutogradBackprop)
    for network, same, initial in zip(whole.agent.networks, resumed.agent.networks, before, strict=True):
        assert torch.equal(network.flat, same.flat)
        assert torch.isfinite(network.flat).all()
        changed = {part for part, view in network.views(network.flat - initial).items() if view.any()}
        assert changed == {part for part, _ in network.layout}
    assert len(next(evaluate_checkpoint(tmp_path / "torn", 2, 0)).returns) == 2


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working directory with the module of the page on networks."""
    page = (Path(__file__).parents[1] / "docs" / "networks.md").read_text()
    (tmp_path / "my_nets.py").write_text(page.split("```python\n")[1].split("```")[0])
    return tmp_path


def _command(folder: Path, name: str) -> subprocess.CompletedProcess[str]:
    return run_command(name, "--network.kind", "my_nets:make", "--total-steps", "200", "--run-dir", name, cwd=folder)


@pytest.mark.parametrize("name", ["coop-lockstep", "coop-local"])
def test_the_network_of_the_page_trains(name: str, folder: Path) -> None:
    done = _command(folder, name)
    assert done.returncode == 0, done.stderr
    summary = json.loads((folder / name / "summary.json").read_text())
    assert (summary["exit"], summary["transitions_lost"]) == ("complete", 0)


def test_a_console_command_refuses_a_network_in_one_line(folder: Path) -> None:
    (folder / "my_nets.py").write_text("def make(spec): return spec")
    refused = _command(folder, "coop-lockstep")
    text = "coop-lockstep: error: network.kind = 'my_nets:make': gives EnvSpec; it must give a torch.nn.Module\n"
    assert (refused.returncode, refused.stderr) == (2, text)


def test_actors_need_the_permission_to_import_it() -> None:
    assert RunConfig(network=NetworkSettings("my_nets:make")).imports == {"network.kind": "my_nets:make"}
