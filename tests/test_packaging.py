"""What is installed and what goes with the source: packages, their data, license, citation and links of pages."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import yaml
from setuptools import find_packages

ROOT = Path(__file__).parents[1]
ROOMS = ("actors", "common", "deploy", "learner", "replay", "coop")  # rglob follows no links
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
IN_CHECKOUTS_ONLY = (
    "coop/deploy/Dockerfile",
    "coop/deploy/*.yaml",
    "coop/deploy/*.sh",
    "coop/deploy/k8s/*",
    "coop/deploy/slurm/*",
    "coop/deploy/zenoh/*",
)
PAGES = sorted(
    ["README.md", "CONTRIBUTING.md", "SECURITY.md"]
    + [str(page.relative_to(ROOT)) for folder in ("docs", "results") for page in (ROOT / folder).rglob("*.md")]
)


def test_every_folder_of_the_package_is_installed_and_no_other_name() -> None:
    found = PROJECT["tool"]["setuptools"]["packages"]["find"]
    packages = find_packages(str(ROOT / found["where"][0]), include=found["include"])
    assert {package.partition(".")[0] for package in packages} == {"coop"}
    folders = {"/".join(package.split(".")) for package in packages}
    modules = [Path(folder, name) for folder, _, names in os.walk(ROOT / "coop", followlinks=True) for name in names]
    here = {path.parent.relative_to(ROOT).as_posix() for path in modules if path.suffix == ".py"}
    assert folders == here


RESEARCH = """
import common, experiments.study, learner, replay
import coop
run = coop.train(total_steps=60, run_dir="run")
run.wait()
print(common.WHOSE, experiments.study.WHOSE, learner.WHOSE, replay.WHOSE, sorted(set(sys.modules) & NAMES))
print(coop.load("run").summary["exit"])
"""


def test_a_research_folder_with_the_names_of_rooms_works_beside_the_package(tmp_path: Path) -> None:
    """Neither side imports the other's modules, and a folder named coop hides nothing."""
    for name in ("common.py", "learner.py", "experiments/study.py", "replay/__init__.py", "actors.py", "deploy.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("WHOSE = 'ours'\n" if name[0] not in "ad" else "raise ValueError('theirs')\n")
    (tmp_path / "coop").mkdir()
    (tmp_path / "research.py").write_text(f"import sys\nNAMES = {{'actors', 'deploy'}}\n{RESEARCH}")
    done = subprocess.run(
        [sys.executable, "research.py"], cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.stdout.splitlines()[-2:] == ["ours ours ours ours []", "complete"], done.stderr


def test_no_two_classes_share_a_name() -> None:
    places: dict[str, list[str]] = {}
    for file in sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(str(file.relative_to(ROOT)))
    assert len(places) > 300
    assert not {name: files for name, files in places.items() if len(files) > 1}


def test_every_data_file_is_installed() -> None:
    data = PROJECT["tool"]["setuptools"]["package-data"]
    allowed = [f"{package.replace('.', '/')}/{pattern}" for package, patterns in data.items() for pattern in patterns]
    walked = os.walk(ROOT / "coop", followlinks=True)
    files = [Path(folder, name).relative_to(ROOT).as_posix() for folder, _, names in walked for name in names]
    others = [path for path in files if not path.endswith(".py") and "__pycache__" not in path]
    assert others
    assert not [path for path in others if not any(fnmatch(path, rule) for rule in (*allowed, *IN_CHECKOUTS_ONLY))]


def test_the_citation_names_the_software_and_the_paper() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= cited.keys()
    assert cited["license"] == PROJECT["project"]["license"] == "MIT"
    assert [author["name"] for author in PROJECT["project"]["authors"]] == [each["name"] for each in cited["authors"]]
    (paper,) = cited["references"]
    assert paper["title"] == "Cooperative Deep Q-learning Framework for Environments Providing Image Feedback"
    assert [f"{each['given-names']} {each['family-names']}" for each in paper["authors"]] == [
        "Krishnan Raghavan",
        "Vignesh Narayanan",
        "Sarangapani Jagannathan",
    ]
    assert paper["identifiers"] == [{"type": "other", "value": "arXiv:2110.15305"}]


@pytest.mark.parametrize("form", ["bug", "feature"])
def test_forms_of_issues(form: str) -> None:
    shown = yaml.safe_load((ROOT / ".github" / "ISSUE_TEMPLATE" / f"{form}.yml").read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= shown.keys()
    assert all(field["type"] == "textarea" and field["attributes"]["label"] for field in shown["body"])
    assert any(field.get("validations", {}).get("required") for field in shown["body"])


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files(page: str) -> None:
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", (ROOT / page).read_text(encoding="utf-8"))
    missing = [link for link in links if "://" not in link and not (ROOT / page).parent.joinpath(link).exists()]
    assert not missing
