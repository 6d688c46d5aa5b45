"""`coop-export`: writes a run's networks, or its buffer, to files that need nothing of this package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from coop.common.errors import UsageError
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
    out: Path | None = None
    """Folder for the networks' files: new, empty, or with an earlier export, which is replaced."""
    dataset: Path | None = None
    """New Parquet file for the transitions of the replay table, one row each."""
    allow_import: tuple[str, ...] = ()
    """Modules, such as my_envs, that may be imported even if they lie in the run's folder or beside it."""


def main() -> None:
    """Entry point."""
    raise_on_signals()
    run_main("coop-export", _run)


def _run() -> None:
    about = (
        "Write both networks of a run's newest checkpoint as safetensors and ONNX, with a card that describes them, or "
        "the transitions of its replay table as Parquet."
    )
    options = parse(ExportOptions, "coop-export", about)
    if options.out is None and options.dataset is None:
        raise UsageError("missing: --out for the networks, or --dataset for the buffer")
    from coop.evaluation.dataset import export_dataset  # noqa: PLC0415 (torch takes seconds; wrong flags should not)
    from coop.evaluation.export import export  # noqa: PLC0415

    permit(options.allow_import)
    place = shown(options.run_dir)
    if options.out is not None:
        done = export(options.run_dir, options.out)
        where = f"checkpoint {done.checkpoint} in {place}"
        print(f"{where}, network {done.acting} acts: {', '.join(done.names)}", file=out())
        if done.without_onnx:
            print(f"no ONNX files: {done.without_onnx}", file=out())
    if options.dataset is not None:
        buffer = export_dataset(options.run_dir, options.dataset)
        rows = f"{len(buffer):,} transitions in {shown(options.dataset)}"
        print(f"checkpoint {buffer.checkpoint} in {place}: {rows}", file=out())
