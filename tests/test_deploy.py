"""The container files agree with the commands: every service's command line is one that its role accepts."""

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from coop.actors.cli import ActorOptions
from coop.common.process import cli
from coop.common.process.ports import http_address
from coop.deploy.router import RouterOptions
from coop.learner.cli import LearnerOptions
from coop.records.run_options import parse_run
from coop.replay.cli import ReplayOptions

DEPLOY = Path(__file__).parents[1] / "deploy"
ROLES = ("learner", "replay", "actor")
FILES = ("compose.yaml", "compose.tls.yaml", "compose.router.yaml")


def services(*files: str) -> dict[str, Any]:
    """The services of Compose files, later files over earlier ones."""
    merged: dict[str, dict[str, Any]] = {}
    for file in files:
        with_defaults = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", (DEPLOY / file).read_text(encoding="utf-8"))
        for name, service in yaml.safe_load(with_defaults)["services"].items():
            merged.setdefault(name, {}).update(service)
    return merged


def parse(line: list[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    program, *flags = line
    monkeypatch.setattr("sys.argv", line)
    if program == "coop-learner":
        return parse_run(LearnerOptions, program, "")
    kinds = {"coop-replay": ReplayOptions, "coop-actor": ActorOptions, "coop-router": RouterOptions}
    return cli.parse(kinds[program], program, "", args=flags)


@pytest.mark.parametrize("overlay", FILES)
def test_each_command_line_is_accepted(overlay: str, monkeypatch: pytest.MonkeyPatch) -> None:
    merged = services("compose.yaml", overlay)
    options = {name: parse(merged[name]["command"], monkeypatch) for name in ROLES}
    protocol = "tls" if "tls" in overlay else "tcp"
    assert {each.run for each in options.values()} == {"compose"}
    assert options["learner"].run_dir == options["replay"].run_dir
    assert options["learner"].resume
    assert options["replay"].resume
    config = options["learner"].run_config()
    assert (config.total_steps, config.replay.journal) == (50_000, "async")
    assert options["replay"].connect[0] == f"{protocol}/learner:7447"
    assert options["learner"].listen == (f"{protocol}/0.0.0.0:7447",)
    for name, each in options.items():
        assert http_address("--health", each.health)[1] == int(
            merged[name]["healthcheck"]["test"][-1].partition(":")[2]
        )
        assert each.zenoh_config == (Path(f"/keys/{name}.json5") if protocol == "tls" else None)


def test_actors_reach_the_router(monkeypatch: pytest.MonkeyPatch) -> None:
    merged = services("compose.yaml", "compose.router.yaml")
    actor, replay, router = (parse(merged[name]["command"], monkeypatch) for name in ("actor", "replay", "router"))
    assert (actor.mode, actor.connect) == ("client", ("tcp/router:7449",))
    assert (router.listen, replay.connect[1]) == (("tcp/0.0.0.0:7449",), "tcp/router:7449")


@pytest.mark.parametrize("overlay", FILES)
def test_every_service_is_restarted_limited_and_asked(overlay: str) -> None:
    for service in services("compose.yaml", overlay).values():
        assert service["restart"] in {"on-failure", "unless-stopped"}
        assert {"healthcheck", "mem_limit"} <= service.keys()


def test_the_image_ends_without_root_and_without_build_tools() -> None:
    steps = (DEPLOY / "Dockerfile").read_text().splitlines()
    last = max(number for number, line in enumerate(steps) if line.startswith("FROM "))
    users = [number for number, line in enumerate(steps) if line.startswith("USER ")]
    assert steps[users[-1]] != "USER root"
    assert not [line for line in steps[users[-1] :] if line.startswith("RUN ")]
    assert not [line for line in steps[last:] if "pip install" in line or "apt-get" in line]


@pytest.mark.skipif(not Path("/etc/ssl/certs/ca-certificates.crt").exists(), reason="no certificates to pass on")
@pytest.mark.parametrize(
    ("listed", "kept"),
    [
        (
            [
                "global.constraint='{at}/constraints.txt'",
                "global.extra-index-url='file:///no/index https://here.example/s'",
            ],
            ["extra-index-url = https://here.example/s"],
        ),
        (
            [
                "global.timeout='15'",
                "install.timeout='60'",
                ":env:.find-links='{at}/wheels /no/such'",
                "install.require-hashes='1'",
            ],
            ["timeout = 60", "find-links = {at}/wheels"],
        ),
        (
            ["global.cert='{at}/own.crt'", ":env:.constraint='/no/such.txt'"],
            ["cert = /etc/ssl/certs/ca-certificates.crt"],
        ),
        ([], []),
    ],
)
def test_the_image_to_build_in_has_what_the_host_s_pip_needs(
    listed: list[str], kept: list[str], tmp_path: Path
) -> None:
    """And nothing that names a file which is not in the image, such as a constraint file of the host."""
    (tmp_path / "wheels").mkdir()
    for file in ("constraints.txt", "own.crt", "wheels/a.whl"):
        (tmp_path / file).write_text(file)
    settings = "".join(f"{line.format(at=tmp_path)}\n" for line in listed)
    script = Path(__file__).parent.parent / "deploy" / "builder_image.sh"
    subprocess.run([script, "base", tmp_path / "image"], input=settings, text=True, check=True)
    root = tmp_path / "image" / "root"
    assert (root / "etc/pip.conf").read_text().splitlines() == [
        "[global]",
        *(line.format(at=tmp_path) for line in kept),
    ]
    assert (root / f"{tmp_path}/wheels/a.whl".lstrip("/")).exists() == any("find-links" in line for line in listed)
    certificates = root / "etc/ssl/certs/ca-certificates.crt"
    assert (certificates.read_text() == "own.crt") == any("cert=" in line for line in listed)
