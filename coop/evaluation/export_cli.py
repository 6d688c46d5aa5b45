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
    """New file NAME.parquet for the transitions of the replay table, one row each; or a new folder, for a Minari data
    set of the run's whole episodes, or such a file where it has none."""
    hub: Path | None = None
    """Folder for a model repository as the Hugging Face Hub takes it: a model card, networks, the run's config and a
    film; new, empty, or with an earlier one, which is replaced. Uploading is a command of its own."""
    allow_import: tuple[str, ...] = ()
    """Modules, such as my_envs, that may be imported even if they lie in the run's folder or beside it."""


def main() -> None:
    """Entry point."""
    raise_on_signals()
    run_main("coop-export", _run)


def _run() -> None:
    about = (
        "Write both networks of a run's newest checkpoint as safetensors and ONNX, with a card that describes them, or "
        "its transitions as Parquet or as a Minari data set, or a repository of the model."
    )
    options = parse(ExportOptions, "coop-export", about)
    if options.out is None and options.dataset is None and options.hub is None:
        raise UsageError("missing: --out for the networks, --dataset for the buffer, or --hub for a model repository")
    from coop.evaluation.dataset import export_to  # noqa: PLC0415 (torch takes seconds; wrong flags should not)
    from coop.evaluation.export import export  # noqa: PLC0415

    permit(options.allow_import)
    place = shown(options.run_dir)
    if options.out is not None:
        done = export(options.run_dir, options.out)
        where = f"checkpoint {done.checkpoint} in {place}"
        print(f"{where}, network {done.acting} acts: {', '.join(done.names)}", file=out())
        if done.without_onnx:
            print(f"no ONNX files: {done.without_onnx}", file=out())
    if options.hub is not None:
        from coop.evaluation.hub import export_hub  # noqa: PLC0415

        print(export_hub(options.run_dir, options.hub), file=out())
    if options.dataset is not None:
        print(export_to(options.run_dir, options.dataset), file=out())
