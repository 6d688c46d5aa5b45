"""What the programs of the registered studies print and draw: tables as Markdown, and small figures."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import pandas as pd
from PIL import Image

from coop.studies.report.plots import Figure, draw


def command(
    program: str,
    about: str | None,
    file: Path,
    tables: Callable[[Path], None],
    figures: Callable[[Path], Iterable[Figure]],
) -> None:
    """Print the tables of a packed file, or draw its figures into `report/` beside it."""
    parser = argparse.ArgumentParser(f"python -m {program}", description=(about or "").split("\n")[0])
    parser.add_argument("what", nargs="?", default="tables", choices=["tables", "figures"])
    parser.add_argument("--file", type=Path, default=file)
    args = parser.parse_args()
    if args.what == "tables":
        tables(args.file)
        return
    for figure in figures(args.file):
        path = args.file.parent / "report" / f"{figure.name}.png"
        path.parent.mkdir(exist_ok=True)
        draw(figure, path)
        _small(path)


def print_tables(tables: Mapping[str, pd.DataFrame]) -> None:
    """Print each table under its name."""
    for name, table in tables.items():
        print(f"\n{name}\n\n{printed(table)}")


def printed(table: pd.DataFrame) -> str:
    """A table as Markdown, numbers with four digits."""
    shown = table.map(lambda value: f"{value:.4g}" if isinstance(value, float) else str(value))
    lines = [shown.columns.map(str), ["---"] * len(shown.columns), *shown.to_numpy()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _small(path: Path) -> None:
    """Store a figure with a palette of colours, in a third of the bytes."""
    Image.open(path).convert("RGB").quantize(48).save(path, optimize=True)
