"""`coop-export`: a run's networks as safetensors and ONNX, which play without this package."""

import hashlib
import json
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import custom_networks
import numpy as np
import onnxruntime
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from coop.common.errors import RunError
from coop.common.networks.network import FlatNetwork, build_network, sample_observations
from coop.common.settings.tables import resolve
from coop.common.types import EnvSpec
from coop.evaluation import export_cli
from coop.evaluation.export import NotExportedError, export, onnx_model
from coop.lockstep.lockstep import Lockstep
from coop.records.run_directory import RunDirectory
from website.pages import blocks


def balance(network: FlatNetwork, sign: float) -> None:
    """Make a network push CartPole's cart towards where the pole leans and turns, if `sign` is 1, or away from it.

    Only the newest of stacked frames counts.
    """
    weights = [layer.weight for layer in network.module if isinstance(layer, nn.Linear)]
    network.flat.zero_()
    for weight in weights:
        weight[:2, :2] = torch.eye(2)
    weights[0][:2, :] = 0
    weights[0][0, -2:], weights[0][1, -2:] = -sign, sign


def saved(path: Path, env: dict[str, Any] | None = None, kind: str = "mlp") -> Lockstep:
    """Save a short run of CartPole whose second network acts and balances the pole, and whose first one does not."""
    tables = {"env": env or {}, "network": {"kind": kind, "hidden": [8, 4]}, "replay": {"learning_starts": 40}}
    run = Lockstep(resolve({"method": "coop", **tables}))
    with RunDirectory(path, run.config) as directory, torch.no_grad():
        for _ in range(60):
            for effects in run.play():
                directory.record(effects.episodes, effects.metrics)
        run.agent.acting = 1
        if run.config.network.kind == "mlp":
            for network, sign in zip(run.agent.networks, (-1, 1), strict=True):
                balance(network, sign)
        run.save(directory)
    run.env.close()
    return run


@pytest.mark.parametrize(("example", "env"), [(0, {}), (1, {"stack": 3})])
def test_the_documented_examples_play_without_this_package(example: int, env: dict[str, Any], tmp_path: Path) -> None:
    snippets = [block.text for block in blocks("docs/export.md") if block.language == "python" and not block.note]
    assert len(snippets) == 2
    assert len(snippets[example].replace("\n\n", "\n").splitlines()) <= 10
    saved(tmp_path / "run", env)
    export(tmp_path / "run", tmp_path / "exported")
    absent = "import sys\nsys.modules['coop'] = None\n"
    played = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", absent + snippets[example]],
        cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert (played.stdout, played.returncode) == ("200.0\n", 0), played.stderr  # the most that CartPole-v0 gives


def test_the_card_and_the_parameters(tmp_path: Path) -> None:
    run = saved(tmp_path / "run", {"kwargs": {"sutton_barto_reward": False}})
    done = export(tmp_path / "run", tmp_path / "a" / "b")
    names = ["network-1.safetensors", "network-1.onnx", "network-2.safetensors", "network-2.onnx", "card.json"]
    assert (done.names, done.checkpoint, done.acting, done.without_onnx) == (names, 20, 2, "")
    assert sorted(path.name for path in (tmp_path / "a" / "b").iterdir()) == sorted(names)
    for number, network in enumerate(run.agent.networks, 1):
        tensors = load_file(tmp_path / "a" / "b" / f"network-{number}.safetensors")
        expected = dict(network.module.named_parameters())
        assert tensors.keys() == expected.keys()
        assert all(torch.equal(tensors[name], expected[name]) for name in tensors)
    card = json.loads((tmp_path / "a" / "b" / "card.json").read_text())
    returns = [float(line.split(",")[5]) for line in (tmp_path / "run" / "episodes.csv").read_text().splitlines()[1:]]
    files = {name: (tmp_path / "a" / "b" / name).read_bytes() for name in names[:-1]}
    assert card.pop("sha256") == {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    assert card == {
        "environment": card["environment"],
        "preprocessing": {
            "stack": 1, "resize": None, "grayscale": False, "axes": [0, 1], "input_shape": [4], "scale": 1.0,
        },
        "network": {
            "kind": "mlp",
            "layers": [
                ["fc1", "Linear", {"in_features": 4, "out_features": 8, "bias": True}],
                ["relu1", "ReLU", {}],
                ["fc2", "Linear", {"in_features": 8, "out_features": 4, "bias": True}],
                ["relu2", "ReLU", {}],
                ["out", "Linear", {"in_features": 4, "out_features": 2, "bias": True}],
            ],
        },
        "spec": {
            "env_id": "CartPole-v0", "frame_shape": [4], "frame_dtype": "float32", "stack": 1, "num_actions": 2,
            "masks": False, "obs_shape": [4], "input_shape": [4],
        },
        "method": "coop",
        "seed": 0,
        "env_steps": 60,
        "updates": 20,
        "acting_network": 2,
        "return_mean_100": pytest.approx(np.mean(returns)),
    }  # fmt: skip
    environment = card["environment"]
    assert (environment["id"], environment["kwargs"]) == ("CartPole-v0", {"sutton_barto_reward": False})
    assert (environment["max_episode_steps"], "stack" in environment) == (0, False)


SPECS = [
    EnvSpec("x", (4,), "float32", 3, 2),
    EnvSpec("x", (12, 9), "float32", 1, 2),
    EnvSpec("x", (10, 10, 4), "bool", 1, 3),
    EnvSpec("x", (10, 9, 4), "bool", 2, 3),
    EnvSpec("x", (36, 40, 3), "uint8", 4, 5),
    EnvSpec("x", (84, 84), "uint8", 4, 6),
]


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: f"{spec.frame_dtype}{spec.obs_shape}")
def test_models_take_observations_as_the_environment_gives_them(spec: EnvSpec) -> None:
    kinds = ["mlp", "minatar"] if len(spec.frame_shape) > 1 else ["mlp", "custom_networks:residual"]
    kinds += ["nature"] if min(spec.frame_shape) > 35 else []
    for kind in kinds:
        network = FlatNetwork(build_network(kind, spec, (6, 5), 1))
        session = onnxruntime.InferenceSession(onnx_model(network, spec))
        for batch in (1, 3):
            obs = sample_observations(spec, batch).numpy()
            (found,) = session.run(None, {"obs": obs})
            np.testing.assert_allclose(found, network.q_values(obs, spec), rtol=1e-4, atol=1e-5)


def test_a_network_of_ones_own(tmp_path: Path) -> None:
    run = saved(tmp_path / "run", kind="custom_networks:residual")
    assert export(tmp_path / "run", tmp_path / "exported").without_onnx == ""
    card = json.loads((tmp_path / "exported" / "card.json").read_text())
    assert (card["network"], card["acting_network"]) == ({"kind": "custom_networks:residual", "layers": None}, 2)
    module = custom_networks.residual(SimpleNamespace(**card["spec"]))  # type: ignore[arg-type]
    module.load_state_dict(load_file(tmp_path / "exported" / "network-2.safetensors"))
    session = onnxruntime.InferenceSession(tmp_path / "exported" / "network-2.onnx")
    obs = torch.randn(5, 4)
    expected = run.agent.networks[1](obs).detach()
    assert torch.equal(module(obs), expected)
    np.testing.assert_allclose(session.run(None, {"obs": obs.numpy()})[0], expected, rtol=1e-4, atol=1e-5)


class Branching(nn.Linear):
    """Has another function for larger batches."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) * (1 if len(x) < 4 else 2)


class Unknown(nn.Linear):
    """Has a layer that ONNX lacks."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) + torch.special.i1e(x[:, :2])


@pytest.mark.parametrize(("kind", "words"), [(Branching, "gives other Q-values"), (Unknown, "special_i1e")])
def test_what_onnx_cannot_hold_is_refused(kind: type[nn.Linear], words: str, spec: EnvSpec) -> None:
    with pytest.raises(NotExportedError, match=words) as refused:
        onnx_model(FlatNetwork(kind(4, 2)), spec)
    assert "\n" not in str(refused.value)


def called(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *flags: object) -> tuple[int, str, str]:
    """Exit status, output and errors of `coop-export`."""
    monkeypatch.setattr("sys.argv", ["coop-export", *map(str, flags)])
    status = 0
    try:
        export_cli.main()
    except SystemExit as ended:
        status = int(ended.code or 0)
    return status, *capsys.readouterr()


def test_without_onnx_an_earlier_export_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(tmp_path / "run")
    out = tmp_path / "exported"
    names = "network-1.safetensors, network-1.onnx, network-2.safetensors, network-2.onnx, card.json"
    first = f"checkpoint 20 in {tmp_path}/run, network 2 acts: {names}\n"
    assert called(monkeypatch, capsys, tmp_path / "run", "--out", out) == (0, first, "")
    before = (out / "network-1.safetensors").read_bytes()
    (out / "network-1.safetensors").write_bytes(b"old")
    monkeypatch.setitem(sys.modules, "onnx", None)
    second = first.replace("network-1.onnx, ", "").replace("network-2.onnx, ", "")
    printed = called(monkeypatch, capsys, tmp_path / "run", "--out", out)
    assert printed == (0, f"{second}no ONNX files: onnx is not installed\n", "")
    assert sorted(path.name for path in out.iterdir()) == [
        "card.json",
        "network-1.safetensors",
        "network-2.safetensors",
    ]
    assert (out / "network-1.safetensors").read_bytes() == before


def test_bad_input_gets_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    saved(tmp_path / "run")
    (tmp_path / "file").write_text("")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "notes.txt").write_text("mine")
    for flags, status, words in (
        ((tmp_path, "--out", tmp_path / "a"), 2, "holds no run"),
        (
            (tmp_path / "run",),
            2,
            "missing: --out for the networks, --dataset for the buffer, or --hub for a model repository",
        ),
        ((), 2, "missing: RUN_DIR"),
        (("", "--out", tmp_path / "a"), 2, "RUN_DIR: an empty value"),
        ((tmp_path / "run", "--otu", tmp_path / "a"), 2, "--otu: unknown; did you mean --out? "),
        ((tmp_path / "run", "--out", tmp_path / "file"), 2, "is no folder"),
        ((tmp_path / "run", "--out", tmp_path / "taken"), 2, "has other files, such as notes.txt"),
        ((tmp_path / "run", "--out", tmp_path / "file" / "a"), 1, "file/a: Not a directory"),
    ):
        found, out, err = called(monkeypatch, capsys, *flags)
        assert (found, out, err.count("\n")) == (status, "", 1), err
        assert err.startswith("coop-export: error: ")
        assert words in err
    assert (tmp_path / "taken" / "notes.txt").read_text() == "mine"
    (tmp_path / "run" / "checkpoints" / "20" / "DONE").unlink()
    found, out, err = called(monkeypatch, capsys, tmp_path / "run", "--out", tmp_path / "a")
    assert (found, out) == (2, "")
    assert "has no complete checkpoint" in err
    assert not (tmp_path / "a").exists()


def test_an_export_that_fails_leaves_the_earlier_one(small_disk: Path, tmp_path: Path) -> None:
    saved(tmp_path / "run")
    out = small_disk / "exported"
    export(tmp_path / "run", out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    free = shutil.disk_usage(small_disk).free
    (small_disk / "ballast").write_bytes(bytes(free - 8192))  # leaves two pages, and the export needs one for each file
    with pytest.raises(RunError, match="exported: No space left on device"):
        export(tmp_path / "run", out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_no_card_stands_beside_networks_that_are_not_its_own(tmp_path: Path) -> None:
    saved(tmp_path / "run")
    out = tmp_path / "exported"
    export(tmp_path / "run", out)
    (out / "network-2.safetensors").unlink()
    (out / "network-2.safetensors").mkdir()
    with pytest.raises(RunError, match="Is a directory"):
        export(tmp_path / "run", out)
    assert [path.name for path in out.iterdir() if path.name == "card.json" or path.suffix == ".part"] == []


def test_the_command_is_installed() -> None:
    command = [Path(sysconfig.get_path("scripts")) / "coop-export", "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True).stdout
    assert "files: new, empty, or with" in " ".join(shown.split()).replace("│ ", "")
