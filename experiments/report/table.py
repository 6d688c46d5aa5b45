"""A table of results, and its formats CSV, Markdown and HTML."""

from __future__ import annotations

import csv
import html
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

Value = str | int | float | None  # None: the number does not exist


@dataclass(frozen=True)
class ResultTable:
    """A table; `name`: of its files. `note`: what a reader must know about it."""

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Value]]
    note: str = ""

    def csv(self) -> str:
        """The table as CSV, with all significant digits; a missing number is empty."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([_exact(value) for value in row] for row in self.rows)
        return out.getvalue()

    def markdown(self) -> str:
        """The table as Markdown, rounded, with title and note."""
        lines = [f"## {self.title}", ""]
        lines += [f"| {' | '.join(self.columns)} |", f"|{' --- |' * len(self.columns)}"]
        lines += [f"| {' | '.join(map(rounded, row))} |" for row in self.rows]
        return "\n".join([*lines, "", *([self.note, ""] if self.note else [])])

    def html(self) -> str:
        """The table as HTML, rounded, without title."""
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self.columns)
        body = "".join(
            "<tr>" + "".join(f"<td>{html.escape(rounded(value))}</td>" for value in row) + "</tr>\n"
            for row in self.rows
        )
        note = f"<p class=note>{html.escape(self.note)}</p>" if self.note else ""
        return f"<table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table>{note}"


def plain(setting: Sequence[object]) -> list[Value]:
    """Convert the values of a setting to a table's values."""
    return [value if isinstance(value, int | float | str) else str(value) for value in setting]


def rounded(value: Value) -> str:
    """Format a value for readers: four digits, or all digits of an integer."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if isinstance(value, float) and not value.is_integer():
        return f"{value:.1f}" if abs(value) >= 100 else f"{value:.3g}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _exact(value: Value) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.10g}" if isinstance(value, float) else str(value)
