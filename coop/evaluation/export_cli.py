"""`coop-export`: writes a run's networks to files that need nothing of this package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from coop.common.imports import permit
from coop.common.places import shown
from coop.common.process.cli import parse
from coop.common.process.lifecycle import raise_on_signals, run_main
from coop.common.process.output import out


@dataclass(frozen=True)
class ExportOptions:
    """Flags of `coop-export`."""

    run_dir: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN_DIR")]
    """Folder of a run, with its config.toml and checkpoints."""
    out: Path
    """Folder for the files: new, empty, or with an earlier export, which is replaced."""
    allow_import: tuple[str, ...] = ()
    """Modules, such as my_envs, that may be imported even if they lie in the run's folder or beside it."""


def main() -> None:
    """Entry point."""
    raise_on_signals()
    run_main("coop-export", _run)


def _run() -> None:
    about = "Write both networks of a run's newest checkpoint as safetensors and ONNX, with a card that describes them."
    options = parse(ExportOptions, "coop-export", about)
    from coop.evaluation.export import export  # noqa: PLC0415 (torch takes seconds; wrong flags should not)

    permit(options.allow_import)
    done = export(options.run_dir, options.out)
    where = f"checkpoint {done.checkpoint} in {shown(options.run_dir)}"
    print(f"{where}, network {done.acting} acts: {', '.join(done.names)}", file=out())
    if done.without_onnx:
        print(f"no ONNX files: {done.without_onnx}", file=out())
