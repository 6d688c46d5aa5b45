"""What a GPU makes of updates, acting and a whole run, in a few minutes: `make gpu`.

Each part (`gpu_parts.py`), and the updates of each method and batch size, is a process of its own with a time limit; it
writes its figures as lines of JSON while it goes, so that a part that fails, or is cut off, costs its own figures only.
On a CPU, for a rehearsal: --device cpu --quick.

    gpu.py [--out FOLDER] [--device cuda] [--seconds 235] [--parts updates profile ...] [--methods dqn ...] [--quick]
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PARTS = {  # with its limit in seconds
    "facts": 15,
    "updates": 80,
    "jax": 45,
    "run": 85,
    "acting": 30,
    "sb3": 25,
    "tests": 150,
    "accuracy": 40,
    "pieces": 40,
    "profile": 40,
}
USUAL = ("facts", "updates", "jax", "run", "acting", "sb3", "tests")  # the tests take what time is left
METHODS = ("dqn", "edql", "g-coop", "coop")
BATCHES = (32, 512)


def main() -> None:
    """Run the parts one after the other, and print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"))
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seconds", type=float, default=235.0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS), help="of the part updates")
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(USUAL))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    began, figures = time.monotonic(), options.out / "gpu.jsonl"
    environment = prepared()
    flags = ["--out", str(options.out), "--device", options.device, *(["--quick"] if options.quick else [])]
    for part in options.parts:
        left = options.seconds - (time.monotonic() - began)
        limit = min(PARTS[part], left)
        if limit < 5:
            say(figures, {"part": part, "skipped": "no time left"})
            continue
        command = [sys.executable, str(Path(__file__).with_name("gpu_parts.py")), part, *flags]
        if part != "updates":
            run_part(part, command, environment, limit, figures)
            continue
        # A process each: nothing that one leaves behind counts for the next.
        until = time.monotonic() + limit
        for batch, method in itertools.product((4,) if options.quick else BATCHES, options.methods):
            if (left := until - time.monotonic()) < 5:
                say(figures, {"part": part, "method": method, "batch": batch, "skipped": "no time left"})
                continue
            run_part(part, [*command, "--case", method, str(batch)], environment, left, figures)
    print(table(figures))
    print(f"{time.monotonic() - began:.0f} s; figures in {figures}")


def run_part(part: str, command: list[str], environment: dict[str, str], limit: float, figures: Path) -> None:
    """Run a part; pass its lines of JSON on, and keep the rest of what it prints in a log."""
    started, log = time.monotonic(), figures.parent / "log.txt"
    with log.open("a+") as errors:
        errors.write(f"=== {part}\n")
        errors.flush()
        before = log.stat().st_size
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment, cwd=ROOT, start_new_session=True
        )
        late = threading.Event()
        cut = threading.Timer(limit, lambda: (late.set(), os.killpg(process.pid, signal.SIGKILL)))
        cut.start()
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("{"):
                say(figures, {"part": part, **json.loads(line)})
            else:
                print(line, end="", flush=True)
        status = process.wait()
        cut.cancel()
    taken = round(time.monotonic() - started, 1)
    say(figures, {"part": part, "seconds": taken, **({"status": status, "cut off": late.is_set()} if status else {})})
    if status:
        said = log.read_bytes()[before:].decode(errors="replace").strip().splitlines()
        print("\n".join(f"    {line}" for line in said[-8:]), flush=True)


def say(figures: Path, row: dict[str, Any]) -> None:
    """Print a figure, and keep it."""
    text = json.dumps(row)
    print(text, flush=True)
    with figures.open("a") as file:
        file.write(text + "\n")


def prepared() -> dict[str, str]:
    """The environment in which this tree and the wheels in .whl/, if there are any, are installed."""
    wheels = sorted((ROOT / ".whl").glob("*.whl"))
    path = [str(ROOT)]
    environment = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false", "PYTHONUNBUFFERED": "1"}
    if wheels and importlib.util.find_spec("gymnasium") is None:
        site = Path(tempfile.mkdtemp(prefix="coop-site-"))
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-compile"]
        subprocess.run(
            [*command, "--no-cache-dir", "--target", site, *wheels],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT,
        )  # fmt: skip
        install_tree(site)
        path.append(str(site))
        environment["PATH"] = f"{site / 'bin'}:{environment['PATH']}"
    environment["PYTHONPATH"] = ":".join([*path, *filter(None, [environment.get("PYTHONPATH")])])
    return environment


def install_tree(site: Path) -> None:
    """Make this tree known to importlib.metadata, with its console commands in bin/, as a build would."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    name, version, scripts = project["name"], project["version"], project["scripts"]
    info = site / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [f"{command} = {target}" for command, target in scripts.items()]
    (info / "entry_points.txt").write_text("\n".join(["[console_scripts]", *lines, ""]))
    (site / "bin").mkdir(exist_ok=True)
    for command, target in scripts.items():
        module, function = target.split(":")
        script = site / "bin" / command
        script.write_text(f"#!{sys.executable}\nimport sys\nfrom {module} import {function}\nsys.exit({function}())\n")
        script.chmod(0o755)


def table(figures: Path) -> str:
    """All figures of the newest run, a line each."""
    rows = [json.loads(line) for line in figures.read_text().splitlines()]
    lines = []
    for row in rows:
        if "what" in row:
            rest = {name: value for name, value in row.items() if name not in ("part", "what", "value")}
            lines.append(
                f"{row['what']:>18} {row.get('value', '')!s:>10}  " + "  ".join(f"{k} {v}" for k, v in rest.items())
            )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
