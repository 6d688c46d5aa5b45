"""The Kubernetes manifests: they refer to what is there, pass flags that the commands take, and fit the schemas."""

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from coop.actors.cli import ActorOptions
from coop.common.process import cli
from coop.deploy.router import RouterOptions
from coop.learner.cli import LearnerOptions
from coop.records.run_options import parse_run
from coop.replay.cli import ReplayOptions
from coop.studies.sweep.cli import SweepOptions
from coop.studies.sweep.grid import load_grid

K8S = Path(__file__).parents[1] / "deploy" / "k8s"
FOLDERS = ["base", "sweep", *(f"overlays/{path.name}" for path in sorted((K8S / "overlays").iterdir()))]
SCHEMAS = "1.33"  # of this version of Kubernetes, and newer ones keep what it takes


def documents(path: Path) -> list[dict[str, Any]]:
    return [each for each in yaml.safe_load_all(path.read_text(encoding="utf-8")) if each]


def kustomization(folder: Path) -> dict[str, Any]:
    (only,) = documents(folder / "kustomization.yaml")
    return only


def resources(folder: Path) -> Iterator[dict[str, Any]]:
    """All manifests that a folder refers to, not yet patched."""
    for name in kustomization(folder)["resources"]:
        path = (folder / name).resolve()
        assert path.exists()
        yield from resources(path) if path.is_dir() else documents(path)


def chain(folder: Path) -> list[dict[str, Any]]:
    """The kustomizations from the base to this folder."""
    found = kustomization(folder)
    below = [path for name in found["resources"] if (path := (folder / name).resolve()).is_dir()]
    return [*(each for path in below for each in chain(path)), found]


def variables(folder: Path) -> dict[str, str]:
    """What the generated ConfigMaps say, overlays last."""
    literals = [
        text for each in chain(folder) for made in each.get("configMapGenerator", []) for text in made["literals"]
    ]
    return dict(text.split("=", 1) for text in literals)


def arguments(folder: Path) -> dict[str, list[str]]:
    """The command lines of all containers, patched, their variables filled in."""
    found: dict[tuple[str, str], list[str]] = {}
    for resource in resources(folder):
        for container in resource["spec"].get("template", {}).get("spec", {}).get("containers", []):
            key = resource["kind"], resource["metadata"]["name"]
            found[key] = [*container["command"], *container["args"]]
    for each in chain(folder):
        for patch in each.get("patches", []):
            target = patch["target"]["kind"], patch["target"]["name"]
            steps = yaml.safe_load(patch["patch"])
            found[target] += [step["value"] for step in steps if step["path"].endswith("/args/-")]
    known = {**variables(folder), "JOB_COMPLETION_INDEX": "23"}
    return {
        line[0]: [re.sub(r"\$\((\w+)\)", lambda name: known[name[1]], part) for part in line] for line in found.values()
    }


@pytest.mark.parametrize("folder", FOLDERS)
def test_what_it_refers_to_is_there(folder: str) -> None:
    made = {made["name"] for each in chain(K8S / folder) for made in each.get("configMapGenerator", [])}
    found = list(resources(K8S / folder))
    names = {(resource["kind"], resource["metadata"]["name"]) for resource in found}
    for resource in found:
        assert {"apiVersion", "kind", "metadata", "spec"} <= resource.keys()
        for container in resource["spec"].get("template", {}).get("spec", {}).get("containers", []):
            assert {source["configMapRef"]["name"] for source in container["envFrom"]} <= made
            ports = {port["name"] for port in container.get("ports", [])}
            probes = [value["httpGet"]["port"] for name, value in container.items() if name.endswith("Probe")]
            assert set(probes) <= ports
        if "scaleTargetRef" in resource["spec"]:
            assert (resource["spec"]["scaleTargetRef"]["kind"], resource["spec"]["scaleTargetRef"]["name"]) in names
    for each in chain(K8S / folder):
        for patch in each.get("patches", []):
            assert (patch["target"]["kind"], patch["target"]["name"]) in names


@pytest.mark.parametrize("folder", FOLDERS)
def test_each_command_line_is_accepted(folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = arguments(K8S / folder)
    assert lines
    for program, line in lines.items():
        flags = line[1:]
        monkeypatch.setattr("sys.argv", line)
        match program:
            case "coop-learner":
                options = parse_run(LearnerOptions, program, "")
                assert options.run_config().run == "demo"
                assert options.resume
            case "coop-replay":
                serving = cli.parse(ReplayOptions, program, "", args=flags)
                assert (serving.run, serving.resume) == ("demo", True)
                assert "learner:7447" in {endpoint.partition("/")[2] for endpoint in serving.connect}
            case "coop-actor":
                playing = cli.parse(ActorOptions, program, "", args=flags)
                assert playing.connect == (
                    ("tcp/router:7449",) if playing.mode == "client" else (f"{line[2][10:13]}/learner:7447",)
                )
            case "coop-router":
                cli.parse(RouterOptions, program, "", args=flags)
            case "coop-sweep":
                sweep = cli.parse(SweepOptions, program, "", args=flags)
                (job,) = (each for each in resources(K8S / folder) if each["kind"] == "Job")
                assert job["spec"]["completions"] == len(load_grid(sweep.grid, sweep.quick).cells)
            case _:
                raise AssertionError(program)


@pytest.mark.parametrize("folder", FOLDERS)
def test_it_fits_the_schemas(folder: str) -> None:
    if shutil.which("kubectl") is None:
        pytest.skip("kubectl is not installed")
    command = ["kubectl", "kustomize", str(K8S / folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if "unknown command" in done.stderr:
        pytest.skip("this kubectl has no kustomize")
    assert done.returncode == 0, done.stderr
    rendered = list(yaml.safe_load_all(done.stdout))
    kinds = {each["kind"] for each in rendered}
    assert {"Job"} <= kinds or {"StatefulSet", "Deployment", "HorizontalPodAutoscaler", "NetworkPolicy"} <= kinds
    validate = pytest.importorskip("kubernetes_validate", reason="the schemas are not installed (extra k8s)")
    for each in rendered:
        validate.validate(each, SCHEMAS, strict=True)
